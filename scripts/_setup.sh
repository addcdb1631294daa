# Sourced by scripts/eyerender and scripts/test: brings this checkout's environment, .venv, up to date.
#
# It needs a Python >= 3.11 with pip (22.3 or newer), but neither ensurepip nor root. A stamp tells whether the
# environment is up to date: a hash of pyproject.toml, constraints.txt, the interpreter and the path of the checkout.
# A failed set-up leaves no stamp. All messages go to stderr. EYERENDER_PYTHON names the interpreter that builds
# .venv.

script=$0
while [ -h "$script" ]; do
    link=$(readlink "$script")
    case $link in /*) script=$link ;; *) script=$(dirname -- "$script")/$link ;; esac
done
root=$(CDPATH='' cd -- "$(dirname -- "$script")/.." && pwd -P) || exit 1
venv=$root/.venv
log=$venv/setup.log
constraints=$root/constraints.txt
ticker=

say() { printf 'eyerender: %s\n' "$*" >&2; }
die() { say "error: $*"; exit 1; }

checksum() {
    if command -v sha256sum >/dev/null; then sha256sum
    elif command -v shasum >/dev/null; then shasum -a 256
    else cksum; fi
}

fingerprint() {
    { printf '%s\n' "$root"; readlink -f "$venv/bin/python" 2>/dev/null || readlink "$venv/bin/python"
      cat "$root/pyproject.toml" "$root/constraints.txt"; } | checksum
}

# There are five set-ups: run, live (the extra `live` too), test (`test`), all (`test`, `ray`, `fuzz` and `oracles`), and docs, which has an
# environment of its own. Each leaves the stamps of those that it holds.
is_set_up() {
    [ -x "$venv/bin/python" ] && [ -f "$venv/.stamp-$1" ] && [ "$(cat "$venv/.stamp-$1")" = "$(fingerprint)" ]
}

find_python() {
    for python in ${EYERENDER_PYTHON:+"$EYERENDER_PYTHON"} python3 python3.13 python3.12 python3.11 python3.14 python; do
        "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && return
    done
    die "Python 3.11 or newer is needed and none was found (EYERENDER_PYTHON=/path/to/python names one)"
}

# flock(2) through Python: macOS has no flock command, and a lock that the kernel drops cannot go stale. The lock
# belongs to the open file, so it outlives the process that takes it, for as long as this shell keeps descriptor 9.
take_lock() {
    { : >>"$root/.venv.lock"; } 2>/dev/null || die "cannot write to $root"
    exec 9>>"$root/.venv.lock"
    "$python" -c 'import fcntl; fcntl.flock(9, fcntl.LOCK_EX | fcntl.LOCK_NB)' 2>/dev/null && return
    say "another set-up of this folder is under way; waiting for it"
    "$python" -c 'import fcntl; fcntl.flock(9, fcntl.LOCK_EX)' || die "cannot lock $root/.venv.lock"
}

make_venv() {
    # One that was made by other means (uv, by hand) is kept; one that was moved, broken or left half done is not.
    if [ ! -e "$venv/.incomplete" ] && { [ ! -e "$venv/.place" ] || grep -qxF "$root" "$venv/.place"; } &&
        "$venv/bin/python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        return
    fi
    rm -rf "$venv"
    "$python" -m venv --without-pip "$venv" >&2 || die "$python cannot make a virtual environment in $venv"
}

find_pip() {
    # Settings that would send the packages elsewhere than into .venv; all others stay as the machine has them.
    unset PIP_TARGET PIP_PREFIX PIP_ROOT PYTHONHOME
    export PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1
    if "$python" -m pip --python "$venv/bin/python" --version >/dev/null 2>&1; then
        pip() { "$python" -m pip --python "$venv/bin/python" "$@"; }
    elif "$venv/bin/python" -m pip --version >/dev/null 2>&1 || "$venv/bin/python" -m ensurepip >/dev/null 2>&1; then
        pip() { "$venv/bin/python" -m pip "$@"; }
    else
        die "$python has no pip (22.3 or newer); on Debian and Ubuntu: apt-get install python3-pip"
    fi
}

# On a terminal, shows that something goes on; elsewhere the lines before and after must do.
start_ticker() {
    [ -t 2 ] || return 0
    (
        trap 'exit 0' TERM
        seconds=0
        while sleep 1; do
            seconds=$((seconds + 1))
            printf '\r  %d packages, %d s ' "$(grep -cE '^(Collecting|Processing|Requirement)' "$log")" "$seconds" >&2
        done
    ) 9>&- &
    ticker=$!
}

stop_ticker() {
    [ -n "$ticker" ] || return 0
    kill "$ticker" 2>/dev/null || :
    wait "$ticker" 2>/dev/null || :
    ticker=
    printf '\r                              \r' >&2
}

# The build backends are installed first and used without isolation: they are pinned too, and fetched once. Setuptools is
# for the one package of the tests (jsonpath-rw) that has no wheel.
install() {
    pip install --no-input --progress-bar off -c "$constraints" hatchling editables setuptools &&
        pip install --no-input --progress-bar off -c "$constraints" --no-build-isolation "$@"
}

# What extras need, one requirement a line.
requirements() {
    "$venv/bin/python" - "$root/pyproject.toml" "$@" <<'PYTHON'
import sys
import tomllib

with open(sys.argv[1], "rb") as file:
    extras = tomllib.load(file)["project"]["optional-dependencies"]
print(*(requirement for extra in sys.argv[2:] for requirement in extras[extra]), sep="\n")
PYTHON
}

failure() {
    if grep -qE 'connection broken by|ResolutionImpossible|No matching distribution' "$log"; then
        echo "the package index does not answer, or lacks a version that is pinned; check the network and pip's settings"
    else
        reason=$(grep -E '^(ERROR|error):' "$log" | head -n 1 | sed 's/^[A-Za-z]*: *//')
        echo "${reason:-$(tail -n 1 "$log")}"
    fi
}

# set_up run|live|test|all|docs: returns at once where the stamp is right.
set_up() {
    is_set_up "$1" && return
    [ -f "$root/constraints.txt" ] || die "$root/constraints.txt is missing"
    find_python
    take_lock
    if is_set_up "$1"; then exec 9>&-; return; fi

    exec 8>&2 # the trap may run while stderr goes to the log
    trap '{ stop_ticker; say "interrupted; run the same command again"; } 2>&8; exit 130' INT TERM HUP
    began=$(date +%s)
    make_venv
    case $1 in
        all) parts="test ray fuzz oracles" stamps="all test run" size="2.1 GB" ;;
        test) parts=test stamps="test run" size="1.3 GB" ;;
        live) parts=live stamps="live run" size="1 GB" ;;
        docs) parts=docs stamps="docs run" size="1 GB" ;;
        *) parts='' stamps=run size="900 MB" ;;
    esac
    wanted=$venv/extras.txt
    # shellcheck disable=SC2086
    requirements $parts >"$wanted" || die "cannot write to $venv"
    if is_set_up run; then # only the extras are missing
        set -- -r "$wanted"
        say "adding the extra '$1' to $venv ..."
    else
        rm -f "$venv"/.stamp-* "$venv"/.llvm*
        printf '%s\n' "$root" >"$venv/.place" && : >"$venv/.incomplete" || die "cannot write to $venv"
        set -- -r "$wanted" -e "$root"
        say "setting up $venv (about $size; later runs start at once) ..."
    fi
    find_pip
    done_=
    for pause in 3 10 0; do
        start_ticker
        if install "$@" >"$log" 2>&1 </dev/null; then done_=1; fi
        stop_ticker
        if [ -n "$done_" ] || grep -q 'No space left' "$log"; then break; fi
        [ "$pause" = 0 ] || { say "that failed; trying again in $pause s"; sleep "$pause"; }
    done
    [ -n "$done_" ] || die "set-up failed: $(failure) (all of it: $log)"
    rm -f "$venv/.incomplete"
    now=$(fingerprint)
    for stamp in $stamps; do printf '%s\n' "$now" >"$venv/.stamp-$stamp"; done
    trap - INT TERM HUP
    exec 8>&- 9>&-
    set_up_extractor
    say "environment ready after $(($(date +%s) - began)) s"
}

# Compiles the extractor and the ray optics, once per version of them. Without it their first use does so.
set_up_extractor() {
    "$venv/bin/python" -m eyerender.extraction.compile || :
    "$venv/bin/python" -m eyerender.analytic.compile || :
}

# Tries once whether rendering works here, and fetches the library that a bare Debian lacks for it. All but rendering works
# without, so a failure is a warning, and is tried again after an hour at the earliest. `.llvm` holds the user's cache
# folder, because users who share a checkout have a cache each, and the files that rendering uses.
set_up_llvm() {
    cache=${XDG_CACHE_HOME-${HOME-}}
    if [ -f "$venv/.llvm" ] && [ "$(head -n 1 "$venv/.llvm")" = "$cache" ]; then
        sed 1d "$venv/.llvm" | while read -r file; do [ -r "$file" ] || exit 1; done && return
    fi
    [ -z "$(find "$venv/.llvm-failed" -mmin -60 2>/dev/null)" ] || return 0
    if files=$("$venv/bin/python" -m eyerender.backends.set_up); then
        printf '%s\n' "$cache" "$files" >"$venv/.llvm.$$"
        mv -f "$venv/.llvm.$$" "$venv/.llvm"
        rm -f "$venv/.llvm-failed"
    else
        [ $? != 130 ] || exit 130
        : >"$venv/.llvm-failed"
    fi
}
