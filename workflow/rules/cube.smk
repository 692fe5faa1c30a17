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
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        code=code_of("cube"),
    message:
        "stacking and adding up every image"
    shell:
        "apertura step cube > {log} 2>&1"
