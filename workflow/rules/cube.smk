rule cube:
    input:
        image=each("results/{flight}/{pair}/image.manifest.json"),
        assessment=each("results/{flight}/assessment.manifest.json"),
        scene="results/scene.manifest.json",
    output:
        "results/cube.manifest.json",
    log:
        "results/logs/cube.log",
    benchmark:
        "results/benchmarks/cube.tsv"
    conda:
        "../../environment.yml"
    threads: job["cube"].threads
    resources:
        **job["cube"].resources,
    params:
        **job["cube"].params,
    message:
        "stacking and summing all images"
    shell:
        "apertura step cube --threads {threads} > {log} 2>&1"
