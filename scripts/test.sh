#!/usr/bin/env bash
# Set everything up, then check style, types and behaviour.
# Extra arguments go to pytest: bash scripts/test.sh -k se3
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
setup "${RENDERING_PACKAGES[@]}" chromium
cd "$REPO"

ruff check .
ruff format --check .
mypy
# Two workers fill the two cores that the tests are sized for.
exec pytest -q -n 2 "$@"
