#!/bin/sh
# Print the path of a Python of the given version that really runs, or nothing.
#
#   sh set_up/find_python.sh 3.11
#
# A name on PATH may be a version manager's shim for a Python that is not enabled. So each candidate is started, first
# those on PATH, then those of pyenv and uv. A Python that can make an environment (ensurepip) is preferred. Debian's cannot
# until python3-venv is installed.
version=$1

candidates() {
    (
        IFS=:
        for folder in $PATH; do
            printf '%s\n' "$folder/python$version" "$folder/python3"
        done
    )
    if command -v pyenv >/dev/null 2>&1; then
        for python in "$(pyenv root)/versions/$version".*/bin/python"$version"; do
            printf '%s\n' "$python"
        done
    fi
    if command -v uv >/dev/null 2>&1; then
        UV_PYTHON_DOWNLOADS=never uv python find "$version" 2>/dev/null
    fi
}

# Print "whole" or "bare" and the interpreter behind the candidate, when it is of the wanted version.
probe() {
    "$1" -I -c '
import importlib.util, sys
if sys.version_info[:2] == tuple(int(part) for part in sys.argv[1].split(".")):
    whole = all(importlib.util.find_spec(name) for name in ("ensurepip", "ssl", "ctypes"))
    print("whole" if whole else "bare", sys.executable)
' "$version" 2>/dev/null
}

bare=
while IFS= read -r candidate; do
    [ -x "$candidate" ] || continue
    found=$(probe "$candidate") || continue
    case $found in
        "whole "*) printf '%s\n' "${found#whole }"; exit 0 ;;
        "bare "*) bare=${bare:-${found#bare }} ;;
    esac
done <<CANDIDATES
$(candidates)
CANDIDATES
[ -n "$bare" ] && printf '%s\n' "$bare"
exit 0
