rule ingest:
    input:
        recording=files(inputs.recording),
        log=files(inputs.log),
    output:
        "results/{flight}/{node}/raw.manifest.json",
        "results/{flight}/{node}/track.manifest.json",
    log:
        "results/logs/{flight}/{node}.ingest.log",
    benchmark:
        "results/benchmarks/{flight}/{node}.ingest.tsv"
    conda:
        "../../environment.yml"
    threads: job["ingest"].threads
    resources:
        **job["ingest"].resources,
    params:
        **job["ingest"].params,
    message:
        "{wildcards.flight}: reading the recording and flight log of {wildcards.node}"
    shell:
        "apertura step ingest {wildcards.flight} {wildcards.node} > {log} 2>&1"


rule bench:
    input:
        recordings=files(inputs.recorded),
    output:
        "results/{flight}/bench.json",
        "results/{flight}/bench.html",
        report(
            "results/{flight}/bench.png",
            caption="../report/bench.rst",
            category="{flight}",
            labels={"image": "all", "shows": "bench"},
        ),
        "results/{flight}/bench.manifest.json",
    log:
        "results/logs/{flight}/bench.log",
    benchmark:
        "results/benchmarks/{flight}/bench.tsv"
    conda:
        "../../environment.yml"
    threads: job["bench"].threads
    resources:
        **job["bench"].resources,
    params:
        **job["bench"].params,
    message:
        "{wildcards.flight}: measuring channels, clocks and links of the bench set-up"
    shell:
        "apertura step bench {wildcards.flight} > {log} 2>&1"
