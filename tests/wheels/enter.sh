#!/bin/sh
# enter.sh ROOT WORK COMMAND…: runs a command of an aarch64 system in ROOT, with the folder WORK as /work. Call it by
# `unshare --user --map-root-user --mount`: the registration of qemu exists in this user namespace only (Linux 6.7 and
# newer), and nothing changes on the machine.
set -e
root=$1 work=$2
shift 2
mount -t binfmt_misc binfmt /proc/sys/fs/binfmt_misc
# ELF header of an aarch64 program and its mask (binfmt.d of Debian's qemu-user-static); F: qemu is opened now, before chroot
printf '%s' ':qemu-aarch64:M::\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00:\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff:/usr/bin/qemu-aarch64-static:F' \
    >/proc/sys/fs/binfmt_misc/register
mkdir -p "$root/proc" "$root/dev" "$root/work"
mount --rbind /proc "$root/proc"
mount --rbind /dev "$root/dev"
mount --rbind "$work" "$root/work"
exec chroot "$root" "$@"
