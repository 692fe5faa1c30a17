rule stac:
    input:
        lambda wildcards: result_of(campaign, "stac").sources,
    output:
        "results/stac/catalog.json",
        "results/stac.manifest.json",
    log:
        "results/logs/stac.log",
    benchmark:
        "results/benchmarks/stac.tsv"
    conda:
        "../../environment.yml"
    threads: asked["stac"].threads
    resources:
        mem_mb=asked["stac"].mem_mb,
        runtime=asked["stac"].runtime,
    params:
        settings=lambda wildcards: result_of(campaign, "stac").settings,
        code=lambda _: result_of(campaign, "stac").code_sha256,
    message:
        "describing every image in a catalog"
    shell:
        "apertura step stac > {log} 2>&1"


# Last of all: it tells of every other result.
rule ro_crate:
    input:
        lambda wildcards: result_of(campaign, "ro_crate").sources,
    output:
        "results/ro-crate-metadata.json",
        "results/ro_crate.manifest.json",
    log:
        "results/logs/ro_crate.log",
    benchmark:
        "results/benchmarks/ro_crate.tsv"
    conda:
        "../../environment.yml"
    threads: asked["ro_crate"].threads
    resources:
        mem_mb=asked["ro_crate"].mem_mb,
        runtime=asked["ro_crate"].runtime,
    params:
        settings=lambda wildcards: result_of(campaign, "ro_crate").settings,
        code=lambda _: result_of(campaign, "ro_crate").code_sha256,
    message:
        "telling the whole run as an RO-Crate"
    shell:
        "apertura step ro-crate > {log} 2>&1"
