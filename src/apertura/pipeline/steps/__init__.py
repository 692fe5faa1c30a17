"""Steps of the workflow: a function opens its sources, calls the physics, stamps and saves; rows in `pipeline.rules`.

`align` writes a clock on request and is no rule; `stamping` is what all of them share.
"""
