# Sourced by run.sh and test.sh; leaves .venv/bin first on PATH, holding exactly what
# scripts/requirements.txt locks, and the Debian packages named as arguments of
# `setup` installed. Does nothing the second time. Messages go to stderr.
set -euo pipefail

REPO="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="$REPO/.venv"
# Headless OpenGL for MuJoCo, software Vulkan for pictures of the recording.
RENDERING_PACKAGES=(
  libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libvulkan1 mesa-vulkan-drivers
)

die() {
  echo "setup: $*" >&2
  exit 2
}

# The first Python that is new enough; $PYTHON goes before all others.
find_python() {
  local candidate
  for candidate in ${PYTHON:+"$PYTHON"} python3 python3.{11..15} python; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
      2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
  die "no Python 3.11 or newer found; install one, or name it: PYTHON=/path/to/python3 bash $0"
}

is_installed() {
  if [[ "$1" == chromium ]] && command -v chromium >/dev/null; then
    return 0 # however it came here
  fi
  [[ "$(dpkg-query -W -f '${db:Status-Status}' "$1" 2>/dev/null)" == installed ]]
}

install_packages() {
  local package missing=() as_root=()
  if ! command -v dpkg-query >/dev/null; then
    echo "setup: this is not Debian; make sure that the equivalents of $* are there" >&2
    return
  fi
  for package in "$@"; do
    is_installed "$package" || missing+=("$package")
  done
  if ((${#missing[@]} == 0)); then
    return
  fi
  if [[ "$(id -u)" != 0 ]]; then
    if ! sudo -n true 2>/dev/null; then
      die "these Debian packages are missing: ${missing[*]}; install them with: sudo apt-get install ${missing[*]}"
    fi
    as_root=(sudo -n)
  fi
  echo "setup: installing the Debian packages ${missing[*]}" >&2
  # With stale package lists the installation can fail, so they come first.
  if ! { "${as_root[@]}" apt-get update -qq &&
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
      apt-get install -y -qq --no-install-recommends "${missing[@]}"; } >&2; then
    die "apt-get could not install ${missing[*]}; install these Debian packages by hand"
  fi
}

# The stamps say what was installed last: a new lock or another Python makes the
# environment anew, a changed pyproject.toml only installs the project again.
install_python() {
  local python="$1" packages project
  packages="$("$python" -VV) $REPO $(sha256sum <"$REPO/scripts/requirements.txt")"
  project="$(sha256sum <"$REPO/pyproject.toml")"
  if [[ "$(cat "$VENV/packages" 2>/dev/null)" != "$packages" ]] ||
    ! "$VENV/bin/python" -c '' 2>/dev/null; then
    echo "setup: installing the locked Python packages into $VENV (a minute or two)" >&2
    rm -rf "$VENV"
    "$python" -m venv "$VENV" >&2 ||
      die "$python could not make a virtual environment at $VENV"
    pip_install --require-hashes -r "$REPO/scripts/requirements.txt" ||
      die "pip could not install scripts/requirements.txt; its message is above"
    echo "$packages" >"$VENV/packages"
  fi
  if [[ "$(cat "$VENV/project" 2>/dev/null)" != "$project" ]]; then
    # The build backend is in the lock too: nothing is fetched here.
    pip_install --no-index --no-deps --no-build-isolation --editable "$REPO" ||
      die "pip could not install the project; its message is above"
    echo "$project" >"$VENV/project"
  fi
}

pip_install() {
  "$VENV/bin/python" -m pip install -qq --disable-pip-version-check "$@" >&2
}

setup() {
  local python packages=("$@")
  # Packages of a sourced ROS or of another Python must not shadow the locked ones.
  unset PYTHONPATH PYTHONHOME VIRTUAL_ENV
  # Two scripts at once take turns; the lock lives on the folder itself.
  exec {lock}<"$REPO"
  flock "$lock"
  python="$(find_python)"
  # Debian splits venv from the interpreter.
  if ! "$python" -c 'import ensurepip' 2>/dev/null; then
    packages+=(python3-venv)
  fi
  install_packages "${packages[@]}"
  install_python "$python"
  exec {lock}<&-
  export PATH="$VENV/bin:$PATH" VIRTUAL_ENV="$VENV"
  # Small problems: a BLAS with many threads is slower than with one.
  export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
  export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
  export MUJOCO_GL="${MUJOCO_GL:-egl}"
}
