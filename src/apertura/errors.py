"""The errors a user can cause, and what each must say."""


class CampaignError(ValueError):
    """Something in the campaign folder is wrong and a person has to change it.

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

    Examples
    --------
    >>> print(CampaignError("spacing_m is -1", where="config/config.yaml: scene",
    ...                     expected="a positive number", remedy="Give metres per pixel."))
    config/config.yaml: scene: spacing_m is -1; expected a positive number. Give metres per pixel.
    """

    def __init__(self, found: str, where: object, expected: str, remedy: str) -> None:
        super().__init__(f"{where}: {found}; expected {expected}. {remedy}")


class ContractError(TypeError):
    """A stage does not hold what its contract promises: a bug of the product, not of the campaign."""
