#!/bin/sh
# Prints the packages of requirements.txt for one kind of installation, for pip: locked.sh robot, demo, dev or tools.
set -eu
awk -v kind="$1" '
    /^[^ #]/ { package = "" }
    { package = package $0 "\n" }
    /^    # for / && $0 " " ~ " " kind " " { printf "%s", package; printed = 1 }
    END { exit !printed }
' "$(dirname "$0")/../requirements.txt" || {
    echo "locked.sh: requirements.txt has no packages for '$1': robot, demo, dev or tools" >&2
    exit 1
}
