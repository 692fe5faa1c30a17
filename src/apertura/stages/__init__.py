"""The stages of the workflow, one module each: what a stage opens, computes and writes, and how others open it.

A rule in `apertura.workflow.rules` names the function of its stage. Modules without a rule open what several stages
share: `acquisition` (pulses of two nodes), `positions`, `air`, `pair` (geometry of a pair), `planning` (engine and
settings), `radiometry`. Imports `apertura.workflow` and the layers below; shows nothing to people but lines of a log.
"""
