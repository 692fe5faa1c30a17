rule cube:
    input:
        [campaign.manifest("image", flight.name, pair) for flight in campaign.image_flights for pair in flight.pairs],
        [campaign.assessment_file(flight.name) for flight in campaign.image_flights],
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
        code=code_sha256("apertura.steps.cube"),
    message:
        "stacking and adding up every image"
    shell:
        "apertura step cube > {log} 2>&1"
