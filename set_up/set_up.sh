#!/bin/sh
# Make an environment with the first Python that fits, unless it is complete already.
#
#   sh set_up/set_up.sh .venv           runs everything: Python 3.11 (Blender 4.5), else 3.13 (Blender 5.3)
#   sh set_up/set_up.sh .venv-next      Python 3.13 (Blender 5.3), where .venv has 3.11 and both are there; else nothing
set -eu
cd "$(dirname "$0")/.."
environment=$1

if [ -x "$environment/bin/python" ] && "$environment/bin/python" -I -S set_up/environment.py check "$environment"; then
    exit 0
fi

case $environment in
    .venv) versions="3.11 3.13" ;;
    *) if [ -x .venv/bin/python3.11 ]; then versions=3.13; else exit 0; fi ;;
esac

for version in $versions; do
    python=$(sh set_up/find_python.sh "$version")
    if [ -n "$python" ]; then
        exec "$python" -I set_up/environment.py make "$environment"
    fi
done

[ "$environment" = .venv ] || exit 0
# What has one of them here: the system's packages, where they do, or uv, which needs no root.
id='' release=''
if [ -r "${OS_RELEASE:=/etc/os-release}" ]; then
    # In a shell of its own, as the file sets many names.
    id=$(. "$OS_RELEASE" && echo "${ID-}")
    release=$(. "$OS_RELEASE" && echo "${VERSION_ID-}")
fi
case "$id $release" in
    "ubuntu 22.04") line="sudo apt-get install python3.11 python3.11-venv" ;;
    "ubuntu 25."* | "debian 12" | "debian 13") line="sudo apt-get install python3 python3-venv" ;;
    fedora*) line="sudo dnf install python3.13" ;;
esac
uv="curl -LsSf https://astral.sh/uv/install.sh | sh && ~/.local/bin/uv python install 3.11"
echo "set-up: no Python 3.11 or 3.13 was found, on PATH or from pyenv or uv. Install one, then run make again:" >&2
echo >&2
echo "    ${line:-$uv}" >&2
exit 1
