"""Commands in addition to the workflow: design, bench, reflectors, align, chart, look; access to campaigns from Python.

The processing steps of the workflow import none of these modules.
"""
