#!/bin/sh
# The tests with the oldest version of every dependency that pyproject.toml allows, in an environment of their own.
# Needs uv: only it resolves to lowest versions. Usage: sh tools/lowest.sh FOLDER [arguments of pytest]
set -eu

venv=${1:?usage: sh tools/lowest.sh FOLDER [arguments of pytest]}
shift
python=${PYTHON:-python3.11}

command -v uv >/dev/null 2>&1 || python3 -m pip install --quiet uv
[ -x "$venv/bin/python" ] || uv venv --quiet --python "$python" "$venv"
uv pip install --quiet --python "$venv/bin/python" --resolution lowest-direct \
    -e ".[dev]"
[ $# -gt 0 ] || set -- -m "not long" -n 2 --ignore tests/notebooks
PATH="$venv/bin:$PATH" "$venv/bin/python" -m pytest "$@"
