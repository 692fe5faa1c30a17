"""Run of the workflow on this machine: start and monitor Snakemake, record and display its progress.

`driver.run_workflow` implements `apertura run`. Imports `apertura.check` and the layers below.
"""
