"""What was measured, in words: a table in Markdown, and the exponents with which seconds grow."""

from typing import Any

import numpy as np

Row = dict[str, Any]


def label(row: Row) -> str:
    """Return who it was, and what was asked of it."""
    return row["name"] if row["aim_db"] is None else f"{row['name']} −{abs(row['aim_db']):.0f} dB"


def ladder(rows: list[Row], geometry: str) -> dict[str, list[Row]]:
    """Return the rows of flat scenes with twice as many pulses as pixels along a side, by contestant and size."""
    found: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: int(row["size"])):
        if (row["geometry"], row["surface"]) == (geometry, "flat") and row["pulses"] == 2 * row["size"]:
            found.setdefault(label(row), []).append(row)
    return found


def power_law(rows: list[Row]) -> tuple[float, float] | None:
    """Return p and log a of seconds = a·sizeᵖ by least squares of logarithms; None of fewer than three sizes."""
    if len(rows) < 3:
        return None
    size, seconds = (np.log([row[key] for row in rows]) for key in ("size", "seconds_from_echoes"))
    power, offset = np.polyfit(size, seconds, 1)
    return float(power), float(offset)


def exponents(rows: list[Row]) -> str:
    """Return the growth of each contestant, a line each: pulses grow with the size, so direct sums take size³."""
    lines = ["| geometry | contestant | sizes | seconds grow as |", "|---|---|---|---|"]
    for geometry in ("monostatic", "bistatic"):
        for name, some in ladder(rows, geometry).items():
            if (fitted := power_law(some)) is not None:
                lines.append(
                    f"| {geometry} | {name} | {some[0]['size']} to {some[-1]['size']} | size^{fitted[0]:.2f} |"
                )
    return "\n".join(lines)


def _directly(row: Row) -> str:
    directly = (row.get("ways") or {}).get("directly")
    return "" if directly is None else f", {directly:.0%}"


def markdown(rows: list[Row]) -> str:
    """Return all rows as a table, ratios against native at −60 dB of the same scene: from profiles and from echoes."""
    lines = [
        "| image × pulses | geometry, ground | contestant | setting | seconds | from echoes | least … most "
        "| × native −60, from echoes | 10⁹ pixel·pulses/s | error dB | share, rounds, load, directly |",
        "|---" * 11 + "|",
    ]
    scenes: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        scenes.setdefault((row["geometry"], row["surface"], row["size"], row["pulses"]), []).append(row)
    for scene in sorted(scenes):
        some = scenes[scene]
        base = next((row for row in some if label(row) == "native −60 dB"), None)
        for row in some:
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
