"""The errors a user can cause, and what each must say."""

_LONGEST = {"where": 400, "found": 1000, "expected": 1000, "remedy": 400}
"""Characters of each part of a message; what a stranger's file holds may be of any length."""


def shown(text: object, longest: int = 80) -> str:
    r"""Return a text as a terminal may show it: one line, control characters as escapes, cut where it is too long.

    Parameters
    ----------
    text
        Of whatever origin; not printed as it stands.
    longest
        Characters that are kept.

    Examples
    --------
    >>> print(shown("red \x1b[31m"), shown("a" * 100, longest=5))
    red \x1b[31m aaaaa…
    """
    line = str(text)
    whole = len(line) <= longest
    line = line[:longest]
    if not line.isprintable():
        line = "".join(one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in line)
    return line if whole and len(line) <= longest else line[:longest] + "…"


def quoted(value: object, longest: int = 80) -> str:
    """Return a value that was read as Python writes it, in quotation marks if it is text, and no longer than that.

    Examples
    --------
    >>> quoted("fast"), quoted(1e308), quoted([0] * 99, longest=4)
    ("'fast'", '1e+308', '[0, 0, …')
    """
    try:
        text = repr(value[:longest] + "…" if isinstance(value, str) and len(value) > longest else value)
    except ValueError:  # an integer of thousands of digits
        text = f"a {type(value).__name__} too long to show"
    return shown(text, longest + 3)


class CampaignError(ValueError):
    """Something in the campaign folder is wrong and a person has to change it.

    What it says may quote a stranger's file: it is one line without control characters, and of bounded length.

    Parameters
    ----------
    found
        What is there, with its value.
    where
        File, and key, line or pulse within it.
    expected
        What would have been right.
    remedy
        What to do about it, in one sentence.

    Attributes
    ----------
    found, where, expected, remedy
        The same, as shown.

    Examples
    --------
    >>> print(CampaignError("spacing_m is -1", where="config/config.yaml: scene",
    ...                     expected="a positive number", remedy="Give metres per pixel."))
    config/config.yaml: scene: spacing_m is -1; expected a positive number. Give metres per pixel.
    """

    def __init__(self, found: str, where: object, expected: str, remedy: str) -> None:
        self.found = shown(found, _LONGEST["found"])
        self.where = shown(where, _LONGEST["where"])
        self.expected = shown(expected, _LONGEST["expected"])
        self.remedy = shown(remedy, _LONGEST["remedy"])
        super().__init__(f"{self.where}: {self.found}; expected {self.expected}. {self.remedy}")

    def __reduce__(self) -> tuple[type["CampaignError"], tuple[str, str, str, str]]:
        return type(self), (self.found, self.where, self.expected, self.remedy)


class ContractError(TypeError):
    """A stage does not hold what its contract promises: a bug of the product, not of the campaign."""
