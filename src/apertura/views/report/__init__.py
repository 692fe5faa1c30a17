"""Figures, tables and text of the report on a campaign."""

PICTURES = ("geometry", "pulses", "phase", "cuts", "range_profiles", "budget")
"""Figures of a pair, in reading order."""

PAGE = "report.html"
"""File name of the report of a flight, and of the report of all flights."""

SUM_PICTURES = ("panels", "sum_cuts")
"""Figures of the sums of a flight: images of the sums and pairs, and cuts through the brightest target."""
