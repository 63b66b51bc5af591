#!/bin/sh
# Makes .venv/ hold exactly what requirements.lock names, and says in one line what is missing if it cannot.
#
#   environment.sh sync    make or renew .venv/; does nothing when it is up to date
#   environment.sh lock    write both lock files anew from pyproject.toml and requirements.in
#
# PYTHON names the interpreter to use; empty: the first of python3.12, python3.11, python3 that fits.
# Runs from the repository's root. The Makefile is its only caller.
set -eu

bootstrap=deploy/bootstrap
environment=.venv
uv_home=.uv
# Written last, so that an interrupted installation is never taken for a finished one.
record=$environment/made-from

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

up_to_date() {
    cmp -s requirements.lock "$record" || return 1
    [ -n "${PYTHON:-}" ] || { fits "$environment/bin/python"; return; }
    [ "$("$PYTHON" -V 2>&1)" = "$("$environment/bin/python" -V 2>&1)" ]
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

sync_environment() {
    if up_to_date; then
        return
    fi
    # Each in a step of its own: a failure inside $(...) ends the script only in a plain assignment.
    python=$(find_python)
    uv=$(find_uv "$python")
    say "installing into $environment/ with $("$python" -V); the first time this fetches a few gigabytes"
    rm -f "$record"
    # Same interpreter: keep the folder, and uv changes only what differs.
    if [ "$("$python" -V)" != "$("$environment/bin/python" -V 2>/dev/null)" ]; then
        "$uv" venv --quiet --clear --no-python-downloads --python "$python" "$environment" ||
            fail "uv could not make $environment/ (see above)"
    fi
    "$uv" pip sync --quiet --python "$environment/bin/python" --require-hashes requirements.lock ||
        fail "the packages of requirements.lock could not be installed (see above)"
    warn_without_opengl
    cp requirements.lock "$record"
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
}

case ${1:-} in
sync) sync_environment ;;
lock) lock ;;
*) fail "usage: $0 sync | lock" ;;
esac
