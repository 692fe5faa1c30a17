"""Operating systems: campaign folders and the command line need Linux; image formation from arrays does not."""

import sys

from apertura.common.errors import CampaignError


def require_linux(part: str) -> None:
    """Refuse a part of apertura on any system but Linux.

    Access to campaign folders relies on ``O_PATH``, ``/proc/self/fd``, ``flock`` and Landlock, and steps rely on
    ``fork`` and ``prctl`` (`apertura.common.confined`, `apertura.common.processes`).

    Parameters
    ----------
    part
        The part, for the message.

    Raises
    ------
    CampaignError
        If the system is not Linux.

    Examples
    --------
    >>> require_linux("ap.open_campaign")
    """
    if sys.platform != "linux":
        raise CampaignError(
            f"operating system {sys.platform!r}",
            where=part,
            expected="Linux, which campaign folders and the command line need",
            remedy="Use a Linux machine, a container or the Windows Subsystem for Linux. Images can be formed from "
            "arrays on this system: ap.PhaseHistory, ap.Profiles and ap.backproject.",
        )
