# A row of `apertura.formats.export.EXPORTS` is all that a product needs: the outputs follow from it.
rule export:
    input:
        header["export"].sources,
    output:
        [
            report(
                file,
                caption="../report/quicklook.rst",
                category="{flight}",
                labels={"image": "{pair}", "shows": "image"},
            )
            for file in header["export"].pictured
        ],
        header["export"].output,
    log:
        header["export"].log,
    benchmark:
        header["export"].benchmark
    conda:
        "../../environment.yml"
    threads: header["export"].threads
    resources:
        mem_mb=header["export"].mem_mb,
        runtime=header["export"].runtime,
    params:
        settings=header["export"].settings,
        code=header["export"].code,
    message:
        "{wildcards.flight}: writing the files of {wildcards.pair}"
    shell:
        "apertura step export {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"


# As large as the echo: made where somebody asks for it, by its name or by rule phase_history.
rule cphd:
    input:
        header["cphd"].sources,
    output:
        header["cphd"].output,
    log:
        header["cphd"].log,
    benchmark:
        header["cphd"].benchmark
    conda:
        "../../environment.yml"
    threads: header["cphd"].threads
    resources:
        mem_mb=header["cphd"].mem_mb,
        runtime=header["cphd"].runtime,
    params:
        settings=header["cphd"].settings,
        code=header["cphd"].code,
    message:
        "{wildcards.flight}: writing the phase history of {wildcards.pair}"
    shell:
        "apertura step cphd {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule export_fused:
    input:
        header["export_fused"].sources,
    output:
        [
            report(
                file,
                caption="../report/quicklook.rst",
                category="{flight}",
                labels={"image": "fused", "shows": "image"},
            )
            for file in header["export_fused"].pictured
        ],
        header["export_fused"].output,
    log:
        header["export_fused"].log,
    benchmark:
        header["export_fused"].benchmark
    conda:
        "../../environment.yml"
    threads: header["export_fused"].threads
    resources:
        mem_mb=header["export_fused"].mem_mb,
        runtime=header["export_fused"].runtime,
    params:
        settings=header["export_fused"].settings,
        code=header["export_fused"].code,
    message:
        "{wildcards.flight}: writing what the pairs add up to"
    shell:
        "apertura step export {wildcards.flight} fused --threads {threads} > {log} 2>&1"


rule coverage:
    input:
        header["coverage"].sources,
    output:
        [report(file, caption="../report/coverage.rst", category="campaign") for file in header["coverage"].pictured],
        header["coverage"].output,
    log:
        header["coverage"].log,
    benchmark:
        header["coverage"].benchmark
    conda:
        "../../environment.yml"
    threads: header["coverage"].threads
    resources:
        mem_mb=header["coverage"].mem_mb,
        runtime=header["coverage"].runtime,
    params:
        settings=header["coverage"].settings,
        code=header["coverage"].code,
    message:
        "drawing what the flights cover"
    shell:
        "apertura step coverage > {log} 2>&1"


rule mosaic:
    input:
        header["mosaic"].sources,
    output:
        [f"results/{file}" for file in mosaic_files(campaign.images, campaign.coefficients)],
        header["mosaic"].output,
    log:
        header["mosaic"].log,
    benchmark:
        header["mosaic"].benchmark
    conda:
        "../../environment.yml"
    threads: header["mosaic"].threads
    resources:
        mem_mb=header["mosaic"].mem_mb,
        runtime=header["mosaic"].runtime,
    params:
        settings=header["mosaic"].settings,
        code=header["mosaic"].code,
    message:
        "writing mosaics of all flights"
    shell:
        "apertura step mosaic > {log} 2>&1"


rule map:
    input:
        header["map"].sources,
    output:
        header["map"].output,
    log:
        header["map"].log,
    benchmark:
        header["map"].benchmark
    conda:
        "../../environment.yml"
    threads: header["map"].threads
    resources:
        mem_mb=header["map"].mem_mb,
        runtime=header["map"].runtime,
    params:
        settings=header["map"].settings,
        code=header["map"].code,
    message:
        "making the map"
    shell:
        "apertura step map > {log} 2>&1"
