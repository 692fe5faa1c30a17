"""Stages of the workflow, one module each: the computation that writes a stage, and the function that opens it.

A rule in `apertura.workflow.rules` names the function of its stage. Modules without a rule contain what several stages
share: `acquisition` (pulses of two nodes), `positions`, `air`, `pair` (geometry of a pair), `planning` (engine and
settings), `radiometry`. Imports `apertura.workflow` and the layers below. Its only output to users is the log.
"""
