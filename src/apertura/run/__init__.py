"""Run of the workflow on this machine: start and monitor Snakemake, and record and display the progress.

`driver.run_workflow` implements `apertura run`. The package imports `apertura.check` and lower layers.
"""
