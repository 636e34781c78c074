#!/bin/sh
# The tests with the oldest version of every dependency that pyproject.toml allows, in an environment of their own
# (uv, which alone resolves to lowest versions, is installed there). Usage: sh tools/lowest.sh FOLDER [arguments of pytest]
set -eu

venv=${1:?usage: sh tools/lowest.sh FOLDER [arguments of pytest]}
shift
[ -x "$venv/bin/python" ] || "${PYTHON:-python3}" -m venv "$venv"
venv=$(cd "$venv" && pwd)
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check uv
"$venv/bin/uv" pip install --quiet --python "$venv/bin/python" --resolution lowest-direct -e ".[dev]"
[ $# -gt 0 ] || set -- -m "not long" -n 2 --ignore tests/notebooks
PATH="$venv/bin:$PATH" "$venv/bin/python" -m pytest "$@"
