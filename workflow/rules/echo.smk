rule echo:
    input:
        header["echo"].sources,
    output:
        header["echo"].output,
    log:
        header["echo"].log,
    benchmark:
        header["echo"].benchmark
    conda:
        "../../environment.yml"
    threads: header["echo"].threads
    resources:
        mem_mb=header["echo"].mem_mb,
        runtime=header["echo"].runtime,
    params:
        settings=header["echo"].settings,
        code=header["echo"].code,
    message:
        "{wildcards.flight}: calibrating {wildcards.pair}"
    shell:
        "apertura step echo {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule transfer:
    input:
        header["transfer"].sources,
    output:
        header["transfer"].output,
    log:
        header["transfer"].log,
    benchmark:
        header["transfer"].benchmark
    conda:
        "../../environment.yml"
    threads: header["transfer"].threads
    resources:
        mem_mb=header["transfer"].mem_mb,
        runtime=header["transfer"].runtime,
    params:
        settings=header["transfer"].settings,
        code=header["transfer"].code,
    message:
        "{wildcards.flight}: keeping the transfer functions of {wildcards.pair}"
    shell:
        "apertura step transfer {wildcards.flight} {wildcards.pair} > {log} 2>&1"


rule calibrate:
    input:
        header["calibrate"].sources,
    output:
        header["calibrate"].output,
    log:
        header["calibrate"].log,
    benchmark:
        header["calibrate"].benchmark
    conda:
        "../../environment.yml"
    threads: header["calibrate"].threads
    resources:
        mem_mb=header["calibrate"].mem_mb,
        runtime=header["calibrate"].runtime,
    params:
        settings=header["calibrate"].settings,
        code=header["calibrate"].code,
    message:
        "{wildcards.flight}: estimating path offsets from the reflector"
    shell:
        "apertura step calibrate {wildcards.flight} > {log} 2>&1"


rule profile:
    input:
        header["profile"].sources,
    output:
        header["profile"].output,
    log:
        header["profile"].log,
    benchmark:
        header["profile"].benchmark
    conda:
        "../../environment.yml"
    threads: header["profile"].threads
    resources:
        mem_mb=header["profile"].mem_mb,
        runtime=header["profile"].runtime,
    params:
        settings=header["profile"].settings,
        code=header["profile"].code,
    message:
        "{wildcards.flight}: compressing {wildcards.pair} in range"
    shell:
        "apertura step profile {wildcards.flight} {wildcards.pair} > {log} 2>&1"
