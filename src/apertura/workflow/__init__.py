"""Graph of the workflow: its rules, the dependencies of results, checks for outdated results, resources of jobs.

`rules` has one row per rule; `lineage` determines sources, settings and code of a result; `stale` compares them with
the manifests of results; `resources` estimates memory and time; `jobs` provides inputs, resources and parameters for
`workflow/*.smk`. The package imports `apertura.campaign` and the layers below, and does not run jobs.
"""
