#!/bin/sh
# Make an environment of the clone, unless it is complete already. Any Python 3 begins; uv brings the right one.
#
#   sh set_up/set_up.sh .venv           runs everything
#   sh set_up/set_up.sh .venv-next      where .venv has Python 3.11 and 3.13 is there, too; else nothing
set -eu
cd "$(dirname "$0")/.."
environment=$1

if [ -x "$environment/bin/python" ] && "$environment/bin/python" -I -S set_up/environment.py check "$environment"; then
    exit 0
fi

# A name on PATH may be a version manager's shim for a Python that is not enabled, or Debian's minimal one.
for python in python3 python3.13 python3.11 /usr/bin/python3; do
    if "$python" -I -c 'import ctypes, ssl, sys; sys.exit(sys.version_info < (3, 8))' 2>/dev/null; then
        exec "$python" -I set_up/environment.py make "$environment"
    fi
done
if command -v uv >/dev/null; then
    exec uv run --no-project --python 3.11 -- python -I set_up/environment.py make "$environment"
fi
echo "set-up: there is no Python 3. Install your system's python3, or uv, then run make again:" >&2
echo >&2
echo "    curl -LsSf https://astral.sh/uv/install.sh | sh" >&2
exit 1
