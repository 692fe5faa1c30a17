"""Stages of the workflow, one module each: the computation that writes a stage, and the function that opens it.

A rule in `apertura.workflow.rules` names the function of its stage. Modules without a rule contain code shared by
several stages: `acquisition` (pulses of two nodes), `positions`, `pair` (geometry of a pair), `planning` (engine and
settings), `radiometry`. This package imports `apertura.workflow` and the layers below it. Its modules write no output
for users except log lines.
"""
