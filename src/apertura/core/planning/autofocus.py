"""Whether the tracks of a flight are refined by its images: only where errors of position cost more than is borne."""

from collections.abc import Collection, Mapping

from apertura.core.planning.plan import Decision

BORNE_DB = 0.2
"""Loss of a peak by errors of position that is borne.

RTK at its best, half a centimetre in each log, costs 0.3 dB at L-band; less than this shows in no image, and is not
worth a job that reads all pairs of a flight together.
"""


def decide_autofocus(asked: str, loss_db: Mapping[str, float], silent: Collection[str]) -> Decision:
    """Return whether tracks are refined, on or off, and why.

    Parameters
    ----------
    asked
        auto, on or off.
    loss_db
        Pair → what errors of position that somebody stated are expected to cost, 0 or less.
    silent
        Nodes of whose errors nobody said anything.

    Examples
    --------
    >>> decide_autofocus("auto", {"a-a": -0.1, "a-b": -0.9}, []).reason
    'auto: errors of position that are stated cost 0.90 dB in a-b, more than the 0.2 dB borne'
    >>> decide_autofocus("auto", {"a-a": 0.0}, ["a"]).value
    'off'
    """
    if asked != "auto":
        return Decision("autofocus", asked, "asked for")
    if silent:
        missing = f"auto: nobody said how well positions of {' and '.join(silent)} are known"
        return Decision("autofocus", "off", f"{missing}; state nodes.<node>.position_std_m to have them refined")
    pair, worst_db = min(loss_db.items(), key=lambda one: one[1])
    value, than = ("on", "more") if worst_db < -BORNE_DB else ("off", "no more")
    cost = f"errors of position that are stated cost {-worst_db:.2f} dB in {pair}"
    return Decision("autofocus", value, f"auto: {cost}, {than} than the {BORNE_DB} dB borne")
