"""What a flight log leaves open and the config must say, and what both say otherwise: one message each."""

import re
from pathlib import Path

import numpy as np

from apertura.common.errors import CampaignError, quoted
from apertura.formats.times import utc_times
from apertura.formats.tracks.log_options import LogOptions

_UNIX = re.compile(r"1970-01-01(?:[T ]00:00(?::00(?:\.0+)?)?)?", re.ASCII)


def unsaid(key: str, found: str, *, node: str, where: Path, remedy: str = "") -> CampaignError:
    """Return the error of a log that leaves open what only a person can say.

    Parameters
    ----------
    key
        Field of `LogOptions`.
    found
        What the log leaves open.
    node, where
        Whose log, and its file.
    remedy
        What else would do.

    Examples
    --------
    >>> print(unsaid("start_utc", "times of day only", node="uav1", where=Path("a.nmea")))
    a.nmea: times of day only; expected key nodes.uav1.log.start_utc in config.yaml. Add it.
    """
    return CampaignError(found, where, f"key nodes.{node}.log.{key} in config.yaml", f"Add it{remedy}.")


def contradicted(key: str, found: str, *, node: str, where: Path) -> CampaignError:
    """Return the error of a log that says otherwise than the config; parameters as `unsaid`.

    Examples
    --------
    >>> print(contradicted("base", "ref pos 48 9 600", node="uav1", where=Path("a.pos")))
    a.pos: ref pos 48 9 600; expected what config.yaml says, nodes.uav1.log.base. Remove the key, if the log is right.
    """
    expected = f"what config.yaml says, nodes.{node}.log.{key}"
    return CampaignError(found, where, expected, "Remove the key, if the log is right.")


def start_time(options: LogOptions, found: str, *, node: str, where: Path) -> np.datetime64:
    """Return time zero of a log, or its day, as the config says it: datetime64[ns], UTC.

    Parameters
    ----------
    options
        With or without start_utc.
    found, node, where
        As of `unsaid`.

    Raises
    ------
    CampaignError
        If it is not there, or no time.

    Examples
    --------
    >>> str(start_time(LogOptions(start_utc="2025-05-14T09:30Z"), "", node="uav1", where=Path("a.csv")))
    '2025-05-14T09:30:00.000000000'
    """
    if options.start_utc is None:
        raise unsaid("start_utc", found, node=node, where=where)
    text = options.start_utc.strip().removesuffix("Z").removesuffix("+00:00")
    if _UNIX.fullmatch(text):  # no recording is that old, but seconds are counted from there
        return np.datetime64(0, "ns")
    try:
        return np.datetime64(utc_times([text])[0])
    except ValueError as error:
        raise CampaignError(
            quoted(options.start_utc),
            f"config.yaml: nodes.{node}.log.start_utc",
            "a time in UTC such as 2025-05-14T09:30:00",
            "Correct it.",
        ) from error
