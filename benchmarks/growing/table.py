"""Results of the growth benchmark: a Markdown table, and the exponents of the growth of run times."""

from typing import Any

import numpy as np

Row = dict[str, Any]


def label(row: Row) -> str:
    """Return the name of a contestant with its requested accuracy."""
    return row["name"] if row["aim_db"] is None else f"{row['name']} −{abs(row['aim_db']):.0f} dB"


def ladder(rows: list[Row], geometry: str) -> dict[str, list[Row]]:
    """Return the rows of flat scenes with twice as many pulses as pixels per side, by contestant and size."""
    by_contestant: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: int(row["size"])):
        if (row["geometry"], row["surface"]) == (geometry, "flat") and row["pulses"] == 2 * row["size"]:
            by_contestant.setdefault(label(row), []).append(row)
    return by_contestant


def power_law(rows: list[Row]) -> tuple[float, float] | None:
    """Fit seconds = a·sizeᵖ by least squares of logarithms; return p and log a, or None for fewer than three sizes."""
    if len(rows) < 3:
        return None
    size, seconds = (np.log([row[key] for row in rows]) for key in ("size", "seconds_from_echoes"))
    power, offset = np.polyfit(size, seconds, 1)
    return float(power), float(offset)


def exponents(rows: list[Row]) -> str:
    """Return a Markdown table of the growth exponents; pulses grow with the size, so that direct sums take size³."""
    lines = ["| geometry | contestant | sizes | seconds grow as |", "|---|---|---|---|"]
    for geometry in ("monostatic", "bistatic"):
        for name, sizes in ladder(rows, geometry).items():
            if (fitted := power_law(sizes)) is not None:
                lines.append(
                    f"| {geometry} | {name} | {sizes[0]['size']} to {sizes[-1]['size']} | size^{fitted[0]:.2f} |"
                )
    return "\n".join(lines)


def _directly(row: Row) -> str:
    directly = (row.get("ways") or {}).get("directly")
    return "" if directly is None else f", {directly:.0%}"


def markdown(rows: list[Row]) -> str:
    """Return all rows as a table, with speeds relative to native at −60 dB on the same scene."""
    lines = [
        "| image × pulses | geometry, terrain | contestant | setting | seconds | from echoes | minimum … maximum "
        "| × native −60, from echoes | 10⁹ pixel·pulses/s | error dB | share, rounds, load, directly |",
        "|---" * 11 + "|",
    ]
    scenes: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        scenes.setdefault((row["geometry"], row["surface"], row["size"], row["pulses"]), []).append(row)
    for scene in sorted(scenes):
        of_scene = scenes[scene]
        base = next((row for row in of_scene if label(row) == "native −60 dB"), None)
        for row in of_scene:
            ratios = [base[key] / row[key] if base and row[key] else None for key in ("seconds", "seconds_from_echoes")]
            ratio = ", ".join("–" if one is None else f"{one:.3g}" for one in ratios)
            seconds = "" if row["seconds"] is None else f"{row['seconds']:.3g}"
            cells = (
                f"{row['size']}² × {row['pulses']}", f"{row['geometry']}, {row['surface']}", label(row),
                row["setting"], seconds, f"{row['seconds_from_echoes']:.3g}",
                f"{row['spread'][0]:.3g} … {row['spread'][1]:.3g}", ratio,
                f"{row['pixel_pulses_per_s'] / 1e9:.3g}", f"{row['error_db']:.1f}",
                f"{row['share']:.2g}, {row['rounds']}, {row['load']}{_directly(row)}",
            )  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
