"""Pictures and words of a report on a campaign, from arrays and numbers."""

PICTURES = ("geometry", "pulses", "phase", "cuts", "range_profiles", "budget")
"""Pictures of a pair, in reading order."""

PAGE = "report.html"
"""The report of a flight, and of all of them."""

SUM_PICTURES = ("panels", "sum_cuts")
"""Pictures of the sums of a flight: beside its pairs, and cuts through the brightest target."""
