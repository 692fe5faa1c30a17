rule cube:
    input:
        lambda wildcards: result_of(campaign, "cube").sources,
    output:
        "results/cube.manifest.json",
    log:
        "results/logs/cube.log",
    benchmark:
        "results/benchmarks/cube.tsv"
    conda:
        "../../environment.yml"
    threads: asked["cube"].threads
    resources:
        mem_mb=asked["cube"].mem_mb,
        runtime=asked["cube"].runtime,
    params:
        code=lambda _: result_of(campaign, "cube").code_sha256,
    message:
        "stacking and adding up every image"
    shell:
        "apertura step cube > {log} 2>&1"
