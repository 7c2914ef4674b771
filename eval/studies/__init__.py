"""Studies that the documentation cites: run when their finding is in doubt."""
