# Sourced by scripts/demo and scripts/test: a virtual environment in .venv with lce-rig in it.
# LCE_RIG_VENV names another place for it; PYTHON another interpreter (3.10 or newer).

cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1
venv=${LCE_RIG_VENV:-.venv}
python=${PYTHON:-python3}

fail() {
  printf 'error: %s\n' "$@" >&2
  exit 5
}

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; elif command -v sudo >/dev/null 2>&1; then sudo "$@"; else return 1; fi
}

# install_system PACKAGE...: by apt where that is possible, else say what to do.
install_system() {
  echo "installing system packages: $*" >&2
  if command -v apt-get >/dev/null 2>&1 && as_root apt-get update -qq && as_root apt-get install -y -qq "$@" >/dev/null; then
    return 0
  fi
  fail "these system packages are needed: $*" "install them, for example: sudo apt-get install $*"
}

command -v "$python" >/dev/null 2>&1 || install_system python3 python3-venv
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
  fail "Python 3.10 or newer is needed, $("$python" --version) found" "name another one: PYTHON=python3.11 $0"

if [ ! -x "$venv/bin/python" ]; then
  "$python" -c 'import ensurepip' 2>/dev/null || install_system python3-venv
  "$python" -m venv "$venv" || fail "could not make the virtual environment $venv"
fi

# The stamp holds what was installed from where, so that a second run starts at once.
wanted="$1 $PWD $(cksum <pyproject.toml)"
if [ "$(cat "$venv/.lce-rig-installed" 2>/dev/null)" != "$wanted" ]; then
  echo "installing lce-rig and what it needs into $venv (a minute the first time)" >&2
  pip=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check)
  # uv downloads in parallel; where it cannot, pip does the same more slowly.
  { "${pip[@]}" uv && "$venv/bin/uv" pip install --quiet --python "$venv/bin/python" -e ".$1"; } ||
    "${pip[@]}" -e ".$1" || fail "pip could not install lce-rig" "see the lines above"
  echo "$wanted" >"$venv/.lce-rig-installed"
fi

# Open3D's wheels leave a few shared libraries to the system.
if ! missing=$("$venv/bin/python" -c 'import open3d' 2>&1); then
  case "$missing" in
    *libusb-1.0*) install_system libusb-1.0-0 ;;
    *libGL.so* | *libEGL*) install_system libgl1 libegl1 ;;
    *libX11*) install_system libx11-6 ;;
    *libgomp*) install_system libgomp1 ;;
  esac
  "$venv/bin/python" -c 'import open3d' || fail "open3d does not load: see the line above"
fi
PATH="$(cd "$venv/bin" && pwd):$PATH"
export PATH
