#!/bin/sh
# Makes .venv/ hold exactly what requirements.lock names, and this distribution in editable form, and says in one line
# what is missing if it cannot.
#
#   environment.sh sync                      make or renew .venv/; does nothing when it is up to date
#   environment.sh sync ENVIRONMENT LOCK     the same for another environment, from its own lock file
#   environment.sh lock                      write all lock files anew from pyproject.toml and the requirements.in
#
# PYTHON names the interpreter to use; empty: the first of python3.12, python3.11, python3 that fits.
# Runs from the repository's root. The Makefile is its only caller.
set -eu

bootstrap=deploy/bootstrap
stable_baselines3=tests/stable_baselines3
environment=${2:-.venv}
lock_file=${3:-requirements.lock}
uv_home=.uv
# What the packages and the distribution in the environment were made from. Written last, so that an interrupted
# installation is never taken for a finished one.
packages_record=$environment/made-from
distribution_record=$environment/distribution-made-from

say() { printf 'relod: %s\n' "$*" >&2; }

fail() {
    say "$@"
    exit 1
}

# A version manager's shim may exist and yet run nothing: only running it tells.
fits() {
    [ "$("$1" -c 'import sys; print((3, 11) <= sys.version_info < (3, 13))' 2>/dev/null)" = True ]
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        fits "$PYTHON" || fail "PYTHON=$PYTHON is not a working Python 3.11 or 3.12"
        echo "$PYTHON"
        return
    fi
    for candidate in python3.12 python3.11 python3; do
        if fits "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    fail "no working Python 3.11 or 3.12 on PATH; install one, or name one: make PYTHON=/path/to/python3.12"
}

# Prints a uv that can install by hash: the one on PATH, or else the pinned one, kept in its own folder.
find_uv() {
    if uv pip sync --help 2>/dev/null | grep -q -e --require-hashes; then
        echo uv
        return
    fi
    if ! cmp -s "$bootstrap/requirements.lock" "$uv_home/made-from" || ! "$uv_home/bin/uv" --version >/dev/null 2>&1; then
        "$1" -c 'import ensurepip, venv' 2>/dev/null ||
            fail "$1 cannot make a virtual environment; on Debian: apt-get install python3-venv"
        say "fetching uv, the installer, into $uv_home/"
        rm -rf "$uv_home"
        "$1" -m venv "$uv_home" || fail "$1 could not make $uv_home/ (see above)"
        "$uv_home/bin/python" -m pip install --quiet --quiet --disable-pip-version-check --only-binary :all: \
            --require-hashes --requirement "$bootstrap/requirements.lock" >&2 ||
            fail "uv could not be installed (see above); is the package index reachable?"
        cp "$bootstrap/requirements.lock" "$uv_home/made-from"
    fi
    echo "$uv_home/bin/uv"
}

packages_up_to_date() {
    cmp -s "$lock_file" "$packages_record" || return 1
    [ -n "${PYTHON:-}" ] || { fits "$environment/bin/python"; return; }
    [ "$("$PYTHON" -V 2>&1)" = "$("$environment/bin/python" -V 2>&1)" ]
}

# An editable installation is the repository's path, the metadata of pyproject.toml, and the start-up file.
distribution_source() {
    pwd
    cat pyproject.toml "$bootstrap"/relod_gymnasium.*
}

distribution_up_to_date() {
    distribution_source | cmp -s - "$distribution_record"
}

# Only MuJoCo's camera images need OpenGL, so its absence is worth a warning and no more.
warn_without_opengl() {
    for backend in egl osmesa; do
        MUJOCO_GL=$backend "$environment/bin/python" -c \
            'import mujoco; mujoco.GLContext(32, 32).make_current()' >/dev/null 2>&1 && return
    done
    say "warning: no OpenGL for MuJoCo's camera images;" \
        "on Debian: apt-get install libegl1 libgl1-mesa-dri (or libosmesa6)"
}

sync_packages() {
    # Each in a step of its own: a failure inside $(...) ends the script only in a plain assignment.
    python=$(find_python)
    uv=$(find_uv "$python")
    say "installing into $environment/ with $("$python" -V); the first time this fetches a few gigabytes"
    rm -f "$packages_record" "$distribution_record"
    # Same interpreter: keep the folder, and uv changes only what differs.
    if [ "$("$python" -V)" != "$("$environment/bin/python" -V 2>/dev/null)" ]; then
        "$uv" venv --quiet --clear --no-python-downloads --python "$python" "$environment" ||
            fail "uv could not make $environment/ (see above)"
    fi
    "$uv" pip sync --quiet --python "$environment/bin/python" --require-hashes "$lock_file" ||
        fail "the packages of $lock_file could not be installed (see above)"
    [ "$environment" != .venv ] || warn_without_opengl
    cp "$lock_file" "$packages_record"
}

# Needs no index: its dependencies and what builds it are in the environment already.
sync_distribution() {
    uv=$(find_uv "$environment/bin/python")
    rm -f "$distribution_record"
    "$uv" pip install --quiet --python "$environment/bin/python" --offline --reinstall --no-deps \
        --no-build-isolation --editable . || fail "this distribution could not be installed into $environment/ (see above)"
    distribution_source >"$distribution_record"
}

sync_environment() {
    packages_up_to_date || sync_packages
    distribution_up_to_date || sync_distribution
}

# Versions already in a lock file are kept where they still fit; delete the file first to take the newest.
compile() {
    "$uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header "$@"
}

lock() {
    python=$(find_python)
    uv=$(find_uv "$python")
    compile pyproject.toml --group dev --output-file requirements.lock
    compile "$bootstrap/requirements.in" --output-file "$bootstrap/requirements.lock"
    compile "$stable_baselines3/requirements.in" --constraint requirements.lock \
        --output-file "$stable_baselines3/requirements.lock"
}

case ${1:-} in
sync) sync_environment ;;
lock) lock ;;
*) fail "usage: $0 sync [ENVIRONMENT LOCK] | lock" ;;
esac
