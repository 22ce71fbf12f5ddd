#!/bin/sh
# Makes .venv and installs this checkout into it, with the extra named by the argument (demo, bench or dev).
# Needs no root and no compiler. make runs it whenever pyproject.toml is newer than its last run.
set -eu
cd "$(dirname "$0")/.."
extra=$1
stubs_version=1.29.0.post1 # of micropython-*-stubs

say() { printf 'pebble: %s\n' "$*"; }
fail() {
    printf 'pebble: %s\n' "$@" >&2
    exit 1
}

# The first suitable Python that has every module named. The system's comes first: every user can run it, unlike one in
# a home folder. $PYTHON overrides the search.
find_python() {
    for name in ${PYTHON:-/usr/bin/python3 python3.11 python3.12 python3.13 python3.14 python3}; do
        if "$name" -c "import sys, $1; sys.exit(sys.version_info < (3, 11))" 2>/dev/null; then
            echo "$name"
            return
        fi
    done
    return 1
}

# Debian's python3 has no ensurepip; pip's wheel from the index can install itself.
fetch_pip() {
    wheel=$(.venv/bin/python tools/fetch_pip.py .venv) && .venv/bin/python "$wheel/pip" install --quiet "$wheel" && rm "$wheel"
}

make_venv() {
    [ -w . ] || fail "$PWD is not writable by $(id -un): clone the project as this user"
    rm -rf .venv
    if python=$(find_python "venv, ensurepip"); then
        say "making .venv with $("$python" --version)"
        "$python" -m venv .venv
    elif python=$(find_python venv); then
        say "making .venv with $("$python" --version), and fetching pip because ensurepip is missing"
        "$python" -m venv --without-pip .venv
        fetch_pip || {
            rm -rf .venv
            sh tools/debian-packages.sh "=python3-venv"
            "$python" -m venv .venv
        }
    else
        fail "Python 3.11 or newer is needed, and none was found. On Debian: apt install python3 python3-venv" \
            "A Python elsewhere: make demo PYTHON=/path/to/python3.12"
    fi
}

# A user without a home (nobody, a service account) has no place for pip's cache.
[ -w "${HOME:-/nonexistent}" ] || export PIP_NO_CACHE_DIR=1
.venv/bin/python -m pip --version >/dev/null 2>&1 || make_venv
say "installing Pebble and its dependencies for '$extra' into .venv; the first time takes a minute"
locked=requirements/$extra.txt

# Not compiled by pip, which has one process for that: compile_all uses all processors.
pip_install() { .venv/bin/python -m pip install --disable-pip-version-check --no-compile "$@" >>.venv/pip.log 2>&1; }

# What cannot be compiled is imported by none of our programs, nor is what packages test themselves with.
compile_all() {
    .venv/bin/python -m compileall -q -j 0 -x '/tests?/' .venv/lib pebble pebble/*/ >/dev/null 2>&1 || true
}

# Those packages of the locked file whose names begin with these letters.
install_part() {
    awk -v mine="^[$1]" '/^[^ #]/ { takes = $0 ~ mine } takes' "$locked" >".venv/$1.txt"
    pip_install --require-hashes --no-deps --only-binary :all: --no-binary esptool -r ".venv/$1.txt"
}

# Tested together, and checked by their hashes: docs/decisions/0017. All are wheels but esptool. By two processes, about
# half each: one pip unpacks with one processor. The file names all that is needed, so neither chooses anything.
install_locked() {
    install_part a-m &
    first_part=$!
    installed=0
    install_part n-z || installed=1
    wait "$first_part" || installed=1
    [ "$installed" = 0 ] && pip_install --no-deps --no-build-isolation --editable .
}

# What pyproject.toml allows. Debian's pip takes twice as long to choose the packages for tests; without a newer one it
# still does.
install_newest() {
    [ "$extra" != dev ] || pip_install --upgrade pip || true
    pip_install --editable ".[$extra]"
}

pip_failed() {
    cat .venv/pip.log >&2
    fail "$1, see above"
}

# Programs in JavaScript that tests use, and type stubs of each board's own modules. The ports' stubs
# contradict each other, so each has its own folder.
fetch_for_tests() {
    .venv/bin/python tools/fetch_npm.py .venv || fail "without it not everything can be tested"
    for port in samd esp32 esp8266; do
        stubs=.venv/stubs/$port
        [ -d "$stubs/micropython_${port}_stubs-$stubs_version.dist-info" ] && continue
        say "installing the type stubs of MicroPython's $port port"
        rm -rf "$stubs"
        .venv/bin/python -m pip install --disable-pip-version-check --target "$stubs" \
            --no-compile "micropython-$port-stubs==$stubs_version" "micropython-stdlib-stubs==1.29.0.post2" \
            >.venv/stubs.log 2>&1 || {
            cat .venv/stubs.log >&2
            fail "pip could not install the stubs of MicroPython's $port port, see above"
        }
    done
}

rm -f .venv/pip.log
[ "$extra" != dev ] || fetch_for_tests &
fetching=$!
# For 32-bit Raspberry Pis there are only piwheels' own builds.
if .venv/bin/python -c "import sys; sys.exit(sys.maxsize < 2**32)" && install_locked; then
    :
else
    ! grep -qs 'DO NOT MATCH THE HASHES' .venv/pip.log || pip_failed "the package index has other files than $locked"
    say "$locked cannot be installed here: $(grep -s ERROR: .venv/pip.log | tail -n 1)"
    say "installing the newest versions that pyproject.toml allows"
    install_newest || pip_failed "pip could not install the dependencies"
fi

wait "$fetching" || exit 1
compile_all
touch ".venv/.ready-$extra"
[ "$extra" != dev ] || touch .venv/.ready-demo .venv/.ready-bench # it includes the others
