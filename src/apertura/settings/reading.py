"""From a config file to `Settings`, or to the one message that says all that is wrong with it."""

from pathlib import Path

from apertura import validation
from apertura.settings.config import Settings


def read_settings(path: Path) -> Settings:
    """Return the settings in a config file.

    Raises
    ------
    CampaignError
        If it is not there, is not YAML, or `validated` refuses it.
    """
    remedy = "`apertura init` writes a commented one."
    return validated(validation.read_yaml(path, expected="a campaign folder", remedy=remedy), where=path)


def validated(document: object, *, where: object) -> Settings:
    """Return `document` as Settings; one message names every wrong key and the nearest valid one.

    Raises
    ------
    CampaignError
        With file, key, what was found and what was expected.

    Examples
    --------
    >>> validated({"campaing": "x"}, where="config.yaml")
    Traceback (most recent call last):
    ...
    apertura.errors.CampaignError: config.yaml: campaing: unknown key (did you mean 'campaign'?); campaign: missing; ...
    """
    expected = "the keys and values of config/config.yaml as `apertura init` writes it"
    return validation.validated(Settings, document, where=where, expected=expected)
