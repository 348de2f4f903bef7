#!/bin/sh
# Run a command inside a Debian tree, as root. Folders and files of this machine that it shall see lie at their own paths.
#
#   sh set_up/in_tree.sh TREE [PATH...] -- COMMAND [ARGUMENT...]
#
# Mounts and processes have namespaces of their own: whatever way the command ends, and if this script is killed, all of
# them are gone with it, and nothing stays mounted in the tree.
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
