rule ingest:
    input:
        lambda wildcards: [
            source
            for stage in ("raw", "track")
            for source in result_of(campaign, stage, wildcards.flight, wildcards.node).sources
        ],
    output:
        "results/{flight}/{node}/raw.manifest.json",
        "results/{flight}/{node}/track.manifest.json",
    log:
        "results/logs/{flight}/{node}.ingest.log",
    benchmark:
        "results/benchmarks/{flight}/{node}.ingest.tsv"
    conda:
        "../../environment.yml"
    threads: asked["ingest"].threads
    resources:
        mem_mb=asked["ingest"].mem_mb,
        runtime=asked["ingest"].runtime,
    params:
        settings=lambda wildcards: campaign.relevant("raw") | campaign.log_settings(wildcards.node),
        code=lambda wildcards: [
            result_of(campaign, part, wildcards.flight, wildcards.node).code_sha256 for part in ("raw", "track")
        ],
    message:
        "{wildcards.flight}: reading the recording and flight log of {wildcards.node}"
    shell:
        "apertura step ingest {wildcards.flight} {wildcards.node} > {log} 2>&1"
