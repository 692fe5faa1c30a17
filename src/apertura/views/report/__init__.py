"""Pictures and words of a report on a campaign, from arrays and numbers."""

PICTURES = ("geometry", "pulses", "phase", "cuts", "range_profiles", "budget")
"""What is drawn of a pair, in the order in which it is read."""

PAGE = "report.html"
"""The report of a flight, and of all of them."""

PANELS = "panels.png"
"""Images of a flight and their sums side by side."""

SUM_CUTS = "cuts.png"
"""Cuts through the brightest target of the coherent sum, beside the panels."""
