#!/bin/sh
# Makes the virtual environment $1 with the first Python 3.11 or 3.12 that can make one.
venv=$1
check='import sys, ensurepip, venv; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))'
"$venv/bin/python" -c "$check" 2>/dev/null && "$venv/bin/python" -m pip --version >/dev/null 2>&1 \
    && exit 0
for python in ${PYTHON3:-python3.12 python3.11 python3}; do
    if "$python" -c "$check" 2>/dev/null; then
        echo "making $venv with $("$python" -V)"
        exec "$python" -m venv --clear "$venv"
    fi
done
echo "make: no Python 3.11 or 3.12 with the venv module found (on Debian and Ubuntu:" \
     "apt install python3.12-venv); or name one: make PYTHON3=/path/to/python3.12 ..." >&2
exit 1
