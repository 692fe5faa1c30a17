"""The graph of the workflow: its rules, what each result is made from, what is out of date, what a job takes.

`rules` has one row per rule; `lineage` gives sources, settings and code of a result; `stale` compares them with what
results record; `resources` estimates memory and time; `jobs` gives `workflow/*.smk` inputs, resources and parameters.
Imports `apertura.campaign` and the layers below; runs nothing.
"""
