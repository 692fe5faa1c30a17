"""Which pulses of a flight make an image, and what the sidelink told of each, over time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from apertura.common.arrays import Floats
from apertura.views.report.sheet import BLUE, GREY, RED, column_of, sheet, thinned

_BINS = 60


@dataclass(frozen=True, eq=False)
class PulseRecord:
    """What is known of the pulses of a pair.

    Attributes
    ----------
    sent_s
        (sent,) float64, when each was sent, seconds from the first.
    kept
        (sent,) bool, whether it makes the image.
    reasons
        Why others do not → how many, as image.json counts them.
    time_s
        (pulse,) float64, of those kept.
    snr_db
        (pulse,) float64, of the sidelink per subcarrier; None without one.
    delay_m
        (pulse,) float64, by how much the sidelink came later than its length says, metres; None without one.
    """

    sent_s: Floats
    kept: NDArray[np.bool_]
    reasons: Mapping[str, int]
    time_s: Floats = field(default_factory=lambda: np.empty(0))
    snr_db: Floats | None = None
    delay_m: Floats | None = None


def draw_pulses(path: Path, record: PulseRecord, *, title: str, tags: Mapping[str, str]) -> None:
    """Draw pulses kept and left out, and SNR and delay of the sidelink where there is one, as a PNG.

    Parameters
    ----------
    path
        ``….png``; complete or absent.
    record
        What is known of the pulses.
    title
        Flight and pair.
    tags
        Provenance; lies in the file.
    """
    heard = [
        (values, label, heading)
        for values, label, heading in (
            (record.snr_db, "SNR, dB", "sidelink, SNR per subcarrier"),
            (record.delay_m, "delay − length, m", "sidelink, delay beyond its length"),
        )
        if values is not None and np.isfinite(values).any()
    ]
    with sheet(path, 2.0 + 1.7 * len(heard), title=title, tags=tags) as figure:
        first, *others = column_of(figure, 1 + len(heard))
        _draw_counts(first, record)
        for axes, (values, label, heading) in zip(others, heard, strict=True):
            _draw_series(axes, record.time_s, values, label, heading)
        [first, *others][-1].set_xlabel("time from the first pulse sent, s")
        first.set_xlim(0.0, max(float(record.sent_s.max(initial=0.0)), 1e-3))


def _draw_counts(axes: Axes, record: PulseRecord) -> None:
    last = float(record.sent_s.max()) if record.sent_s.size else 0.0
    interval = float(np.median(np.diff(record.sent_s))) if last else 1.0
    width = interval * max(1, np.ceil(last / interval / _BINS))  # of whole intervals, else columns seem to lack pulses
    edges = np.arange(-interval / 2, last + width, width)
    kept, left = (np.histogram(record.sent_s[some], edges)[0] for some in (record.kept, ~record.kept))
    axes.stairs(kept, edges, fill=True, color=BLUE, label=f"kept: {int(record.kept.sum())}")
    axes.stairs(
        kept + left,
        edges,
        baseline=kept,
        fill=True,
        facecolor=RED,
        edgecolor="white",
        hatch="////",
        linewidth=0,
        label=f"left out: {int((~record.kept).sum())}{_why(record.reasons)}",
    )
    axes.set(title="pulses", ylabel=f"pulses in {width:.2g} s", ylim=(0, 1.45 * max(1, (kept + left).max())))
    axes.legend(loc="upper right", ncols=2)


def _why(reasons: Mapping[str, int]) -> str:
    """Return the reasons in a few words.

    Examples
    --------
    >>> _why({"unpaired": 9, "sidelink_lost": 2}), _why({})
    (' (9 unpaired, 2 sidelink lost)', '')
    """
    told = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in reasons.items())
    return f" ({told})" if told else ""


def _draw_series(axes: Axes, time_s: Floats, values: Floats, label: str, heading: str) -> None:
    some = thinned(len(values))
    median = float(np.nanmedian(values))
    axes.plot(time_s[some], values[some], ".", color=BLUE, markersize=2, rasterized=True)
    axes.axhline(median, color=GREY, linewidth=0.8, linestyle="--")
    spread = 1.4826 * float(np.nanmedian(np.abs(values - median)))
    unlocked = int(np.isnan(values).sum())
    lost = f"; {unlocked} pulses without lock" if unlocked else ""
    unit = label.rpartition(", ")[2]
    axes.set(title=f"{heading}: median {median:.3g} {unit}, spread {spread:.2g} {unit}{lost}", ylabel=label)
