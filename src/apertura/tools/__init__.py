"""Commands beside the workflow, each with its view: design, bench, reflectors, align, chart, look; campaigns in Python.

Nothing that a run needs imports them.
"""
