# Figures and pages of the report, made on demand by `apertura report` or rule pages.
rule pictures:
    input:
        echo="results/{flight}/{pair}/echo.manifest.json",
        profile="results/{flight}/{pair}/profile.manifest.json",
        image="results/{flight}/{pair}/image.manifest.json",
        layers="results/{flight}/{pair}/layers.manifest.json",
        raw=files(inputs.transmitter_raw),
        refined_track="results/{flight}/refined_track.manifest.json",
        scene="results/scene.manifest.json",
        terrain=each("results/terrain.manifest.json"),
    output:
        report(
            "results/{flight}/{pair}/pictures/geometry.png",
            caption="../report/geometry.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "geometry"},
        ),
        report(
            "results/{flight}/{pair}/pictures/pulses.png",
            caption="../report/pulses.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "pulses"},
        ),
        report(
            "results/{flight}/{pair}/pictures/phase.png",
            caption="../report/phase.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "phase"},
        ),
        report(
            "results/{flight}/{pair}/pictures/cuts.png",
            caption="../report/cuts.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "cuts"},
        ),
        report(
            "results/{flight}/{pair}/pictures/range_profiles.png",
            caption="../report/range_profiles.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "range profiles"},
        ),
        report(
            "results/{flight}/{pair}/pictures/budget.png",
            caption="../report/budget.rst",
            category="{flight}",
            labels={"image": "{pair}", "shows": "budget"},
        ),
        "results/{flight}/{pair}/pictures.manifest.json",
    log:
        "results/logs/{flight}/{pair}.pictures.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.pictures.tsv"
    conda:
        "../../environment.yml"
    threads: job["pictures"].threads
    resources:
        **job["pictures"].resources,
    params:
        **job["pictures"].params,
    message:
        "{wildcards.flight}: drawing figures of {wildcards.pair} for the report"
    shell:
        "apertura step pictures {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule pictures_fused:
    input:
        export=each("results/{flight}/{pair}/export.manifest.json"),
        image=each("results/{flight}/{pair}/image.manifest.json"),
        assessment="results/{flight}/assessment.manifest.json",
        fused=each("results/{flight}/fused/export.manifest.json"),
        scene="results/scene.manifest.json",
    output:
        report(
            "results/{flight}/fused/panels.png",
            caption="../report/panels.rst",
            category="{flight}",
            labels={"image": "fused", "shows": "panels"},
        ),
        report(
            "results/{flight}/fused/sum_cuts.png",
            caption="../report/sum_cuts.rst",
            category="{flight}",
            labels={"image": "fused", "shows": "sum cuts"},
        ),
        "results/{flight}/fused/pictures.manifest.json",
    log:
        "results/logs/{flight}/fused.pictures_fused.log",
    benchmark:
        "results/benchmarks/{flight}/fused.pictures_fused.tsv"
    conda:
        "../../environment.yml"
    threads: job["pictures_fused"].threads
    resources:
        **job["pictures_fused"].resources,
    params:
        **job["pictures_fused"].params,
    message:
        "{wildcards.flight}: drawing figures of the sums for the report"
    shell:
        "apertura step pictures-fused {wildcards.flight} > {log} 2>&1"


rule payload:
    input:
        recordings=files(inputs.recorded),
    output:
        "results/{flight}/payload/payload.json",
        report(
            "results/{flight}/payload/payload.png",
            caption="../report/payload.rst",
            category="{flight}",
            labels={"image": "all", "shows": "payload"},
        ),
        "results/{flight}/payload/payload.manifest.json",
    log:
        "results/logs/{flight}/payload.payload.log",
    benchmark:
        "results/benchmarks/{flight}/payload.payload.tsv"
    conda:
        "../../environment.yml"
    threads: job["payload"].threads
    resources:
        **job["payload"].resources,
    params:
        **job["payload"].params,
    message:
        "{wildcards.flight}: reading the data in the frames"
    shell:
        "apertura step payload {wildcards.flight} > {log} 2>&1"


rule page:
    input:
        pictures=each("results/{flight}/{pair}/pictures.manifest.json"),
        pictures_fused=each("results/{flight}/fused/pictures.manifest.json"),
        export=each("results/{flight}/{pair}/export.manifest.json"),
        fused=each("results/{flight}/fused/export.manifest.json"),
        scene="results/scene.manifest.json",
        changes=files(inputs.changes),
        payload=each("results/{flight}/payload/payload.manifest.json"),
    output:
        report(
            "results/{flight}/report.html",
            caption="../report/page.rst",
            category="{flight}",
            labels={"image": "all", "shows": "results section, to be printed"},
        ),
        "results/{flight}/page.manifest.json",
    log:
        "results/logs/{flight}/page.log",
    benchmark:
        "results/benchmarks/{flight}/page.tsv"
    conda:
        "../../environment.yml"
    threads: job["page"].threads
    resources:
        **job["page"].resources,
    params:
        **job["page"].params,
    message:
        "{wildcards.flight}: writing the report page"
    shell:
        "apertura step page {wildcards.flight} > {log} 2>&1"
