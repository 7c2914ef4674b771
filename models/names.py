"""Names of denoisers such as wskp6@quick+adaptive+js: a denoiser, the training of its weights, and wrappers."""

import re
from dataclasses import dataclass, replace

from errors import BadInput

SYNTAX = re.compile(r"([^@+]+)(?:@([^@+]+))?((?:\+[^@+]+)*)")


@dataclass(frozen=True)
class DenoiserName:
    """A name in its parts; `str` returns the name."""

    base: str  # a key of registry.DENOISERS, which is also what its weights are called
    budget: str | None = None  # the training budget of its weights, kept in RUNS; None for the weights that are shipped
    wrappers: tuple[str, ...] = ()  # keys of registry.WRAPPERS, innermost first

    @classmethod
    def parse(cls, text: str) -> "DenoiserName":
        """The parts of a name. Raises BadInput where it is not BASE[@BUDGET][+WRAPPER...]."""
        match = SYNTAX.fullmatch(text)
        if not match:
            raise BadInput(f"'{text}' is no name of a denoiser: write NAME, NAME@BUDGET or NAME+WRAPPER")
        return cls(match[1], match[2], tuple(match[3].split("+")[1:]))

    def __str__(self) -> str:
        budget = f"@{self.budget}" if self.budget else ""
        return self.base + budget + "".join(f"+{wrapper}" for wrapper in self.wrappers)

    def with_budget(self, budget: str | None) -> "DenoiserName":
        """The same denoiser with the weights of another budget, or with the shipped weights."""
        return replace(self, budget=budget)

    def wrapped(self, wrapper: str) -> "DenoiserName":
        return replace(self, wrappers=(*self.wrappers, wrapper))
