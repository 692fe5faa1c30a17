rule ingest:
    input:
        header["ingest"].sources,
    output:
        header["ingest"].output,
    log:
        header["ingest"].log,
    benchmark:
        header["ingest"].benchmark
    conda:
        "../../environment.yml"
    threads: header["ingest"].threads
    resources:
        mem_mb=header["ingest"].mem_mb,
        runtime=header["ingest"].runtime,
    params:
        settings=header["ingest"].settings,
        code=header["ingest"].code,
    message:
        "{wildcards.flight}: reading the recording and flight log of {wildcards.node}"
    shell:
        "apertura step ingest {wildcards.flight} {wildcards.node} > {log} 2>&1"


rule bench:
    input:
        header["bench"].sources,
    output:
        [
            report(file, caption="../report/bench.rst", category="{flight}", labels={"image": "all", "shows": "bench"})
            for file in header["bench"].pictured
        ],
        header["bench"].output,
    log:
        header["bench"].log,
    benchmark:
        header["bench"].benchmark
    conda:
        "../../environment.yml"
    threads: header["bench"].threads
    resources:
        mem_mb=header["bench"].mem_mb,
        runtime=header["bench"].runtime,
    params:
        settings=header["bench"].settings,
        code=header["bench"].code,
    message:
        "{wildcards.flight}: measuring channels, clocks and links on the bench"
    shell:
        "apertura step bench {wildcards.flight} > {log} 2>&1"
