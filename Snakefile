# `snakemake --directory CAMPAIGN` runs a campaign folder; `apertura run CAMPAIGN` does the same. No `configfile:`: YAML
# from a stranger would run as code; the workflow reads and checks config/config.yaml itself.
import os

from apertura.common.processes import STATUS_FILE


module apertura:
    snakefile:
        "workflow/Snakefile"
    config:
        config


use rule * from apertura


onsuccess:
    if STATUS_FILE not in os.environ:  # `apertura run` says it on its own
        shell("apertura summary 2> /dev/null || true")  # nothing to say before every image is there
