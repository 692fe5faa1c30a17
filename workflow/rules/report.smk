# What the report shows and says, made where somebody asks for it: `apertura report`, or rule pages.
rule pictures:
    input:
        header["pictures"].sources,
    output:
        [
            report(
                f"results/{{flight}}/{{pair}}/pictures/{name}.png",
                caption=f"../report/{name}.rst",
                category="{flight}",
                labels={"image": "{pair}", "shows": name.replace("_", " ")},
            )
            for name in PICTURES
        ],
        header["pictures"].output,
    log:
        header["pictures"].log,
    benchmark:
        header["pictures"].benchmark
    conda:
        "../../environment.yml"
    threads: header["pictures"].threads
    resources:
        mem_mb=header["pictures"].mem_mb,
        runtime=header["pictures"].runtime,
    params:
        settings=header["pictures"].settings,
        code=header["pictures"].code,
    message:
        "{wildcards.flight}: drawing {wildcards.pair} for the report"
    shell:
        "apertura step pictures {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule pictures_fused:
    input:
        header["pictures_fused"].sources,
    output:
        [
            report(
                file,
                caption=f"../report/{Path(file).stem}.rst",
                category="{flight}",
                labels={"image": "fused", "shows": Path(file).stem.replace("_", " ")},
            )
            for file in header["pictures_fused"].pictured
        ],
        header["pictures_fused"].output,
    log:
        header["pictures_fused"].log,
    benchmark:
        header["pictures_fused"].benchmark
    conda:
        "../../environment.yml"
    threads: header["pictures_fused"].threads
    resources:
        mem_mb=header["pictures_fused"].mem_mb,
        runtime=header["pictures_fused"].runtime,
    params:
        settings=header["pictures_fused"].settings,
        code=header["pictures_fused"].code,
    message:
        "{wildcards.flight}: drawing what the pairs add up to for the report"
    shell:
        "apertura step pictures-fused {wildcards.flight} > {log} 2>&1"


rule page:
    input:
        header["page"].sources,
    output:
        report(
            f"results/{{flight}}/{PAGE}",
            caption="../report/page.rst",
            category="{flight}",
            labels={"image": "all", "shows": "results section, to be printed"},
        ),
        header["page"].output,
    log:
        header["page"].log,
    benchmark:
        header["page"].benchmark
    conda:
        "../../environment.yml"
    threads: header["page"].threads
    resources:
        mem_mb=header["page"].mem_mb,
        runtime=header["page"].runtime,
    params:
        settings=header["page"].settings,
        code=header["page"].code,
    message:
        "{wildcards.flight}: writing the page of the report"
    shell:
        "apertura step page {wildcards.flight} > {log} 2>&1"
