#!/bin/sh
# Every executable is a link to this file; its name is the command.
# Runs with the Python of the environment it was installed into, else with the one on PATH.
python="$(dirname -- "$0")/../../bin/python3"
[ -x "$python" ] || python=python3
exec "$python" -m eha_monitor "$(basename -- "$0")" "$@"
