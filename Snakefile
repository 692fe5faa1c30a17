# `snakemake --directory CAMPAIGN` runs a campaign folder; `apertura run CAMPAIGN` does the same. No `configfile:`: YAML
# from a stranger would run as code; the workflow reads and checks config/config.yaml itself.
module apertura:
    snakefile:
        "workflow/Snakefile"


use rule * from apertura


onsuccess:
    shell("apertura summary 2> /dev/null || true")  # nothing to say before every image is there
