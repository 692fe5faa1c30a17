"""Graph of the workflow: rules, dependencies of results, detection of out-of-date results, and resources of jobs.

`rules` has one row per rule. `lineage` determines the sources, settings and code of a result. `stale` compares these
with the manifests of results. `resources` estimates memory and time. `jobs` provides inputs, resources and parameters
for `workflow/*.smk`. The package imports `apertura.campaign` and lower layers, and does not run jobs.
"""
