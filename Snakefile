# `snakemake --directory CAMPAIGN` runs a campaign folder; `apertura run CAMPAIGN` does the same.
configfile: "config/config.yaml"


module apertura:
    snakefile:
        "workflow/Snakefile"
    config:
        config


use rule * from apertura
