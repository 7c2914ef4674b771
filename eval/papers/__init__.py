"""What the papers print, beside what is measured here."""
