#!/usr/bin/env bash
# DisWM from a fresh clone: makes .venv, checks OpenGL, then runs the paper's pipeline or the tests.
# Run it from any folder and as often as you like: finished work is skipped, cut work goes on.
set -euo pipefail
CDPATH='' cd -- "$(dirname -- "${BASH_SOURCE[0]}")"

# Left to itself, MuJoCo picks GLFW, which needs a display.
export MUJOCO_GL=${MUJOCO_GL:-egl}

# The small preset, cut down until all of it takes ten minutes on two CPU cores: flags of all three
# stages, and of one each.
tour=(--preset small --prefill 1000 --eval-every 4000 --eval-episodes 3)
tour_collect=(--collect-steps 4000)
tour_pretrain=(--pretrain-updates 200)
tour_finetune=(--steps 8000)

usage() {
    cat <<'EOF'
usage: bash run_all.sh                 a tour of the whole pipeline: ten minutes on two CPU cores
       PRESET=small bash run_all.sh    the real thing, sized for two CPU cores: hours
       PRESET=paper bash run_all.sh    the paper's size: wants a GPU
       bash run_all.sh list            prints the commands instead, one a line, teachers first
       bash run_all.sh test [ARGS]     ruff and the tests; ARGS go to pytest, as in: test -k replay

What the pipeline runs, each a list separated by spaces:
       PAIRS      source:target tasks, by default "cheetah_run:walker_walk"
       METHODS    methods of diswm.py, by default "diswm"
       SEEDS      seeds of the finetunings, by default "0"
       JOBS       finetunings side by side, by default 1 on a GPU, else one per core
       SWEEP      values to compare, of diswm alone: SWEEP="eta=0.01,0.1,1", or beta, beta2, z_dim;
                  each is a run of its own, tagged diswm+eta=0.01; beta2, z_dim get a teacher each

Set-up: PYTHON=/path/to/python makes .venv with that Python; MUJOCO_GL=osmesa renders without EGL.
EOF
}

die() {  # MESSAGE [EXIT CODE]
    echo "error: $1" >&2
    exit "${2:-1}"
}

# ---- Set-up --------------------------------------------------------------------------------------

usable_python() {  # PYTHON MODULE: does it run, has it the module, and have all pins wheels for it?
    "$1" -c "import sys, $2; sys.exit(not (3, 11) <= sys.version_info < (3, 13))" >/dev/null 2>&1
}

find_python() {
    local candidate candidates=(python3.11 python3.12 python3 python)
    if [[ -n ${PYTHON:-} ]]; then
        candidates=("$PYTHON")
    fi
    for candidate in "${candidates[@]}"; do
        if usable_python "$candidate" ensurepip; then  # which venv needs; Debian packs it apart
            echo "$candidate"
            return
        fi
    done
    die "no Python >=3.11,<3.13 with its venv module (tried: ${candidates[*]}). On Debian 12 or\
 Ubuntu 24.04: apt-get install -y python3 python3-venv; or name one: PYTHON=/path/to/python"
}

install() {
    .venv/bin/python -m pip install --disable-pip-version-check "$@"
}

make_venv() {
    local python stamp=.venv/requirements.sha256
    if ! usable_python .venv/bin/python pip; then
        python=$(find_python)
        echo "Making .venv with $("$python" --version)"
        "$python" -m venv --clear .venv
    fi
    # The stamp is written last: after an interrupted or changed installation it does not fit.
    if ! sha256sum --check --status "$stamp" 2>/dev/null; then
        echo "Installing requirements.txt into .venv: some minutes, this once"
        if ! command -v nvidia-smi >/dev/null; then  # PyPI's torch brings gigabytes of CUDA along
            install "$(grep ^torch== requirements.txt)" --timeout 20 --retries 1 \
                --index-url https://download.pytorch.org/whl/cpu || echo "Taking PyPI's torch"
        fi
        install -r requirements.txt
        sha256sum requirements.txt >"$stamp"
    fi
}

try_rendering() {  # a real picture: importing MuJoCo already works where rendering does not
    .venv/bin/python - <<'EOF'
import mujoco

model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 64, 64)
renderer.update_scene(data)
renderer.render()
renderer.close()
EOF
}

check_opengl() {
    local why packages install
    if why=$(try_rendering 2>&1); then
        return
    fi
    case $MUJOCO_GL in
        egl) packages="libegl1 libgl1 libgl1-mesa-dri" ;;
        osmesa) packages="libosmesa6" ;;
        *) die "MuJoCo cannot render with MUJOCO_GL=$MUJOCO_GL; use egl (the default) or osmesa" ;;
    esac
    install="apt-get update; apt-get install -y $packages"
    if [[ $EUID == 0 ]] && command -v apt-get >/dev/null; then
        echo "MuJoCo cannot render with MUJOCO_GL=$MUJOCO_GL yet; running: $install"
        export DEBIAN_FRONTEND=noninteractive
        apt-get update || true  # one unreachable source need not matter
        # shellcheck disable=SC2086  # several packages
        apt-get install -y $packages || true  # whether it helped is seen below
        if why=$(try_rendering 2>&1); then
            return
        fi
    fi
    die "MuJoCo cannot render with MUJOCO_GL=$MUJOCO_GL (${why##*$'\n'}).\
 On Debian and Ubuntu, run as root: $install"
}

# ---- The pipeline --------------------------------------------------------------------------------

diswm() {
    echo "\$ python diswm.py $*"
    .venv/bin/python diswm.py "$@"
}

read_settings() {  # environment variables -> size, collect, pretrain, finetune (flags of the
                   # stages), runs, pairs, methods, settings, trainings
    local preset=${PRESET:-tour} pair method seed setting once=" "
    case $preset in
        tour)
            size=("${tour[@]}")
            collect=("${tour_collect[@]}")
            pretrain=("${tour_collect[@]}" "${tour_pretrain[@]}")
            finetune=("${tour_finetune[@]}")
            ;;
        small | paper | debug)
            size=(--preset "$preset")
            collect=() pretrain=() finetune=()
            ;;
        *) die "PRESET=$preset does not exist; use small or paper, or none for the tour" 2 ;;
    esac
    runs=runs/$preset  # apart, since a run only goes on with the settings that it was started with
    size+=(--runs "$runs")

    if [[ ! ${JOBS:-1} =~ ^[1-9][0-9]*$ ]]; then
        die "JOBS=$JOBS is no number of finetunings, as in JOBS=3" 2
    fi
    pairs=${PAIRS:-cheetah_run:walker_walk}
    methods=${METHODS:-diswm}
    read_sweep
    trainings=()  # of each finetuning: its run folder, then its flags
    for pair in $pairs; do
        if [[ ! $pair =~ ^[A-Za-z0-9_-]+:[A-Za-z0-9_-]+$ || ${pair%:*} == "${pair#*:}" ]]; then
            die "PAIRS: '$pair' is not two different tasks, as in cheetah_run:walker_walk" 2
        fi
        for method in $methods; do
            if ! needs_videos "$method"; then  # whatever the source: once per target
                [[ $once == *" $method:${pair#*:} "* ]] && continue
                once+="$method:${pair#*:} "
            fi
            for setting in "${settings[@]}"; do
                for seed in ${SEEDS:-0}; do
                    trainings+=("$runs/finetune/${pair/:/-}/$method${setting:++}$setting/seed$seed\
 ${size[*]} ${finetune[*]} --src ${pair%:*} --dst ${pair#*:} --method $method --seed $seed\
 $(finetune_flags "$setting" "${pair%:*}")")
                done
            done
        done
    done
}

needs_videos() {  # METHOD
    [[ $1 != dreamerv2 && $1 != no_distill ]]
}

read_sweep() {  # SWEEP="a=1,2 b=3" -> settings=(a=1 a=2 b=3), or one empty one
    local entry value
    settings=()
    for entry in ${SWEEP:-}; do
        if [[ ! $entry =~ ^[a-z0-9_]+=[0-9.e,-]+$ || $methods != diswm ]]; then
            die "SWEEP: '$entry' is not NAME=VALUE,… as in eta=0.01,0.1,1, or METHODS is not diswm" 2
        fi
        local values=${entry#*=}
        for value in ${values//,/ }; do
            settings+=("${entry%%=*}=$value")
        done
    done
    settings=("${settings[@]:-}")
}

own_teacher() {  # SETTING: does it change the pretraining?
    [[ $1 == beta2=* || $1 == z_dim=* || $1 == beta1=* ]]
}

setting_flags() {  # eta=0.1 -> --tag eta=0.1 --eta 0.1
    local name=${1%%=*}
    echo "--tag $1 --${name//_/-} ${1#*=}"
}

finetune_flags() {  # SETTING SOURCE
    local flags
    [[ -n $1 ]] || return 0
    flags=$(setting_flags "$1")
    if [[ $1 == beta[12]=* ]]; then  # of pretraining alone
        flags="--tag $1"
    fi
    if own_teacher "$1"; then
        flags+=" --teacher $runs/pretrain/$2/diswm+$1/seed0/checkpoint.pt"
    fi
    echo "$flags"
}

check_settings() {  # a misspelt target or method must not show only after hours of pretraining
    printf '%s\n' "${trainings[@]}" | .venv/bin/python -c '
import sys
import diswm

try:
    for line in sys.stdin:
        given, defaults = diswm.parse_args(["finetune", *line.split()[1:]])
        del given["command"], given["fresh"]
        cfg = diswm.replace(defaults, **given)
        diswm.check_task(cfg.src)
        diswm.check_task(cfg.dst)
except diswm.UserError as error:
    print(f"error: {error}", file=sys.stderr)
    sys.exit(2)'
}

teacher_commands() {  # one per source and method, with seed 0: it serves all seeds
    local source method setting flags
    for source in $(printf '%s\n' $pairs | sed 's/:.*//' | sort -u); do
        for method in $methods; do
            needs_videos "$method" || continue
            echo "collect --src $source ${size[*]} ${collect[*]}"
            for setting in "${settings[@]}"; do
                flags=
                if own_teacher "$setting"; then
                    flags=$(setting_flags "$setting")
                fi
                echo "pretrain --src $source --method $method ${size[*]} ${pretrain[*]} $flags"
            done
        done
    done | awk '!seen[$0]++'  # several methods share their videos
}

pretrain_teachers() {
    local command words
    while read -r command; do
        read -ra words <<<"$command"
        diswm "${words[@]}" </dev/null
    done < <(teacher_commands)
}

list_commands() {  # those of one source must wait for each other, so they share a line
    local training
    teacher_commands | awk '
        { source = $3; line = ".venv/bin/python diswm.py " $0
          if (source in lines) lines[source] = lines[source] " && " line
          else { order[++n] = source; lines[source] = line } }
        END { for (i = 1; i <= n; i++) print lines[order[i]] }'
    for training in "${trainings[@]}"; do
        echo ".venv/bin/python diswm.py finetune ${training#* }"
    done
}

finetune_into_log() {  # RUN [FLAGS]
    local run=$1 log=$1.log code=0  # beside the run, which a start from nothing clears
    mkdir -p "${run%/*}"
    echo "started   $run, which writes $log"
    diswm finetune "${@:2}" >>"$log" 2>&1 || code=$?
    if [[ $code != 0 ]]; then
        echo "error: $run stopped with exit code $code: $(tail -n 1 "$log")" >&2
        return "$code"
    fi
    echo "finished  $run"
}

has_cuda() {
    .venv/bin/python -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'
}

finetune_all() {
    local training flags cores side_by_side=${JOBS:-}
    cores=$(nproc)
    if [[ -z $side_by_side ]]; then
        side_by_side=$(has_cuda && echo 1 || echo "$cores")
    fi
    side_by_side=$((${#trainings[@]} < side_by_side ? ${#trainings[@]} : side_by_side))
    if [[ $side_by_side == 1 ]]; then
        for training in "${trainings[@]}"; do
            read -ra flags <<<"${training#* }"
            diswm finetune "${flags[@]}"
        done
        return
    fi
    # Each gets its share of the cores: two trainings on the same two cores slow each other tenfold.
    # xargs stays in the foreground, so that Ctrl-C reaches every training.
    export -f diswm finetune_into_log
    printf "%s --threads $((cores > side_by_side ? cores / side_by_side : 1))\n" "${trainings[@]}" |
        xargs -P "$side_by_side" -L 1 bash -c 'finetune_into_log "$@"' finetune_into_log ||
        die "a finetuning failed, see above; run the same command again to go on"
}

show_results() {
    local training run plot by=pair
    if [[ -n $(printf '%s\n' $pairs | sed 's/.*://' | sort | uniq -d) ]]; then
        by=src  # a target of several sources: Fig. 8
    fi
    plot=(results/plot.py --out "$runs/curves.png" --by "$by")
    for training in "${trainings[@]}"; do
        run=${training%% *}
        diswm evaluate --run "$run"
        diswm traverse --run "$run"
        plot+=("$run")
    done
    echo "\$ python ${plot[*]}"
    .venv/bin/python "${plot[@]}"

    echo
    echo "Done in $((SECONDS / 60)) minutes. In $PWD:"
    echo "  learning curves  $runs/curves.png"
    for training in "${trainings[@]}"; do
        run=${training%% *}
        echo "  pictures, video  $run:" "$(cd "$run" && echo *.png *.mp4)"
    done
}

say_time() {
    if [[ $runs != runs/tour ]]; then  # whose time is known
        echo "Each stage, for one pair, method and seed, takes" \
            "$(.venv/bin/python results/bench.py --estimate "${size[@]:0:2}")"
    fi
}

say_tour() {
    if [[ $runs == runs/tour ]]; then
        echo
        echo "This size is a tour, not a result: every stage runs, but too briefly to learn much."
        echo "The real one: PRESET=small bash run_all.sh   (hours on two CPU cores)"
        echo
    fi
}

# ---- The two commands ----------------------------------------------------------------------------

run_tests() {
    .venv/bin/python -m ruff check .
    .venv/bin/python -m pytest test_diswm.py -m "not slow" "$@"  # of two -m, pytest takes the last
}

run_pipeline() {
    say_tour
    check_settings
    say_time
    pretrain_teachers
    finetune_all
    show_results
    say_tour
}

if [[ $# == 0 ]]; then
    read_settings
    make_venv
    check_opengl
    run_pipeline
elif [[ $1 == list && $# == 1 ]]; then
    read_settings
    make_venv >&2
    check_settings
    list_commands
elif [[ $1 == test ]]; then
    make_venv
    check_opengl
    run_tests "${@:2}"
elif [[ $1 == -h || $1 == --help ]]; then
    usage
else
    usage >&2
    exit 2
fi
