# Sourced by setup_pupil_detectors.sh and setup_cheshm.sh: makes the environment of a detector that bench-extractors runs.
#
# They set `name`, `version` and `module`, the package on PyPI and what it is imported as. The environment goes to
# $XDG_CACHE_HOME/eyerender/$name (else ~/.cache/...). It needs Python 3.9 or newer with pip (22.3 or newer);
# EYERENDER_PYTHON names one. The last line of stdout is the interpreter.

say() { printf '%s: %s\n' "${0##*/}" "$*" >&2; }
die() { say "error: $*"; exit 1; }

case ${XDG_CACHE_HOME-} in
    /*) cache=$XDG_CACHE_HOME ;;
    *) [ -n "${HOME-}" ] || die "there is no home folder; set XDG_CACHE_HOME to a writable folder"; cache=$HOME/.cache ;;
esac
place=$cache/eyerender/$name
works() { [ -x "$1/bin/python" ] && "$1/bin/python" -c 'import numpy, PIL, '"$module" 2>/dev/null; }

case ${1-} in
    --force) rm -rf "$place" ;;
    '') ;;
    *) say "usage: ${0##*/} [--force]"; exit 2 ;;
esac
if works "$place"; then
    say "is set up already"
    printf '%s\n' "$place/bin/python"
    exit 0
fi

for python in ${EYERENDER_PYTHON:+"$EYERENDER_PYTHON"} python3 python3.12 python3.11 python3.13 python; do
    if "$python" -m pip --version >/dev/null 2>&1; then break; fi
    python=
done
[ -n "$python" ] || die "no Python with pip was found (EYERENDER_PYTHON=/path/to/python names one)"

umask 077  # the environment runs as you, so nobody else may write to it
mkdir -p "${place%/*}" || die "cannot write to ${place%/*}"
log=$place.log
say "making $place ..."
# Without --without-pip a Debian python lacks ensurepip; pip works on the new environment from outside.
rm -rf "$place"
trap 'rm -rf "$place"; say "interrupted"; exit 130' INT TERM HUP
unset PIP_TARGET PIP_PREFIX PIP_ROOT PYTHONHOME
export PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1
"$python" -m venv --without-pip "$place" >"$log" 2>&1 || die "$python cannot make an environment in $place ($log)"
if ! "$python" -m pip --python "$place/bin/python" install --no-input --progress-bar off --only-binary :all: \
    "$name==$version" pillow >>"$log" 2>&1; then
    reason=$(grep -E '^ERROR' "$log" | tail -n 1 | sed 's/^ERROR: *//')
    rm -rf "$place"
    die "${reason:-pip failed} (all of it: $log)"
fi
if ! works "$place"; then
    rm -rf "$place"
    die "$name $version is installed but cannot be imported"
fi
rm -f "$log"
say "ready"
printf '%s\n' "$place/bin/python"
