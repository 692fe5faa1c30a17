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
