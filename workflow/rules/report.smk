# What the report shows and says, made where somebody asks for it: `apertura report`, or rule pages.
rule pictures:
    input:
        lambda wildcards: result_of(campaign, "pictures", wildcards.flight, wildcards.pair).sources,
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
        "results/{flight}/{pair}/pictures.manifest.json",
    log:
        "results/logs/{flight}/{pair}.pictures.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.pictures.tsv"
    conda:
        "../../environment.yml"
    threads: asked["pictures"].threads
    resources:
        mem_mb=asked["pictures"].mem_mb,
        runtime=asked["pictures"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda wildcards: result_of(campaign, "pictures", wildcards.flight, wildcards.pair).code_sha256,
    message:
        "{wildcards.flight}: drawing {wildcards.pair} for the report"
    shell:
        "apertura step pictures {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule page:
    input:
        lambda wildcards: result_of(campaign, "page", wildcards.flight).sources,
    output:
        report(
            f"results/{{flight}}/{PAGE}",
            caption="../report/page.rst",
            category="{flight}",
            labels={"image": "all", "shows": "results section, to be printed"},
        ),
        report(
            f"results/{{flight}}/fused/{PANELS}",
            caption="../report/panels.rst",
            category="{flight}",
            labels={"image": "all", "shows": "pairs and their sums"},
        ),
        "results/{flight}/page.manifest.json",
    log:
        "results/logs/{flight}/page.log",
    benchmark:
        "results/benchmarks/{flight}/page.tsv"
    conda:
        "../../environment.yml"
    threads: asked["page"].threads
    resources:
        mem_mb=asked["page"].mem_mb,
        runtime=asked["page"].runtime,
    params:
        settings=lambda _: campaign.settings.campaign,
        code=lambda wildcards: result_of(campaign, "page", wildcards.flight).code_sha256,
    message:
        "{wildcards.flight}: writing the page of the report"
    shell:
        "apertura step page {wildcards.flight} > {log} 2>&1"
