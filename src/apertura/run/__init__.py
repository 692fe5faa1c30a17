"""A run on this machine: Snakemake is started and followed, its progress shown and recorded.

`driver.run_workflow` is what `apertura run` calls. Imports `apertura.check` and the layers below.
"""
