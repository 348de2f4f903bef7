#!/bin/sh
# Run a command inside a Debian tree, as root. The folders and files PATH of this machine appear there at the same paths.
#
#   sh set_up/in_tree.sh TREE [PATH...] -- COMMAND [ARGUMENT...]
#
# Mounts and processes have their own namespaces. They end with the command, also if this script is killed, so nothing
# stays mounted in the tree.
set -eu
tree=$1
shift
if [ "${PLGS_IN_TREE-}" != "$tree" ]; then
    PLGS_IN_TREE=$tree
    export PLGS_IN_TREE
    exec unshare --mount --pid --fork --kill-child sh "$0" "$tree" "$@"
fi
mount -t proc proc "$tree/proc"
mount --rbind /dev "$tree/dev"
mount -t tmpfs tmpfs "$tree/tmp"
while [ "$1" != -- ]; do
    if [ -d "$1" ]; then
        mkdir -p "$tree$1"
    else
        mkdir -p "$tree${1%/*}"
        [ -e "$tree$1" ] || : >"$tree$1"
    fi
    mount --bind "$1" "$tree$1"
    shift
done
shift
unset PLGS_IN_TREE
exec chroot "$tree" "$@"
