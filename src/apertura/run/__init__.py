"""Run of the workflow on this machine: start and monitor Snakemake, record and display its progress.

`driver.run_workflow` implements `apertura run`. The package imports `apertura.check` and the layers below.
"""
