"""Commands in addition to the workflow: design, bench, reflectors, align, chart, look; access to campaigns from Python.

No module of the workflow's processing steps imports them.
"""
