"""Names of what other people's files hold, as Mitsuba can use them."""

from collections import Counter

TAKEN = ("type", "id", "sky")  # what a Mitsuba scene's dictionary begins with


class Names:
    """Gives each thing a name of its own."""

    def __init__(self) -> None:
        self.given = set(TAKEN)
        self.asked: Counter[str] = Counter()

    def unique(self, wanted: str) -> str:
        """The wanted name without dots, which separate a name from its parameters; numbered where it is taken."""
        plain = name = wanted.replace(".", "_") or "unnamed"
        while name in self.given:
            self.asked[plain] += 1
            name = f"{plain}-{self.asked[plain] + 1}"
        self.given.add(name)
        return name
