#!/usr/bin/env bash
# Set everything up, then calibrate the HP3-like cell from rendered images into ./out.
# Extra arguments go to the command: bash scripts/run.sh --seed 2
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
setup "${RENDERING_PACKAGES[@]}"
exec handeye-tri run hp3_stereo -o out --seed 1 "$@"
