#!/usr/bin/env bash
# Resolve pyproject.toml into scripts/requirements.txt: every version pinned, every
# file hashed, no address of an index in it. One version serves all Pythons, so that
# numbers and types do not depend on which one is there. Needs uv. Extra arguments go
# to uv:
#   bash scripts/lock.sh --upgrade
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if ! command -v uv >/dev/null; then
  echo "lock.sh needs uv; install it with: python -m pip install uv" >&2
  exit 2
fi
exec uv pip compile pyproject.toml --universal --python-version 3.11 --extra test \
  --fork-strategy fewest --generate-hashes --no-emit-index-url --no-annotate --quiet \
  --custom-compile-command "bash scripts/lock.sh" \
  --output-file scripts/requirements.txt "$@"
