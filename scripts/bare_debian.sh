# Functions that scripts/fresh and scripts/image share. Bash reads this file with `source`. The
# scripts set $log_folder, and the array $binds for in_root.
# shellcheck shell=bash disable=SC2154

suite=bookworm

say() { printf '%s: %s\n' "${0##*/}" "$*"; }
fail() {
    printf '%s: %s\n' "${0##*/}" "$*" >&2
    exit 1
}

# timed WHAT COMMAND...: runs the command with its output in $log_folder/WHAT.log, and prints the
# seconds that it took. Where the command fails, prints the end of the log and exits.
timed() {
    local what=$1 begun=$SECONDS
    shift
    local log=$log_folder/${what//[^A-Za-z0-9.]/_}.log
    # In an `if` the command would run without `set -e`.
    set +e
    (set -e; "$@") > "$log" 2>&1 < /dev/null
    local status=$?
    set -e
    if [ $status != 0 ]; then
        tail -n 60 "$log" >&2
        fail "$what FAILED after $((SECONDS - begun)) s; the whole output is in $log"
    fi
    say "$what: $((SECONDS - begun)) s"
}

# bare_root FOLDER: a bare Debian 12 by debootstrap, which reaches the registries as this machine
# does: the same mirror, the same proxies, the same certificates.
bare_root() {
    local mirror
    # The loop's names are those that apt fills in.
    # shellcheck disable=SC2016
    mirror=$(apt-get indextargets --format '$(ORIGIN) $(CODENAME) $(REPO_URI)' \
        "Created-By: Packages" 2> /dev/null | sed -n "s/^Debian $suite //p" | head -n 1)
    debootstrap --variant=minbase "$suite" "$1" ${mirror:+"$mirror"}
    # The chroot starts no service.
    printf '#!/bin/sh\nexit 101\n' > "$1/usr/sbin/policy-rc.d"
    chmod +x "$1/usr/sbin/policy-rc.d"
    apt-config dump | grep -E '^Acquire::(https?::|Retries|Check-Valid-Until|Check-Date)' \
        > "$1/etc/apt/apt.conf.d/00host" || true
    cp -L /etc/resolv.conf "$1/etc/resolv.conf"
    cp -L /etc/hosts "$1/etc/hosts"
    local config
    for config in /etc/pip.conf "${XDG_CONFIG_HOME:-$HOME/.config}/pip/pip.conf"; do
        [ ! -f "$config" ] || cp "$config" "$1/etc/pip.conf"
    done
    local certificates=/usr/local/share/ca-certificates
    if [ -n "$(ls -A $certificates 2> /dev/null)" ]; then
        mkdir -p "$1$certificates"
        cp -L $certificates/* "$1$certificates/"
    fi
}

# cargo_registries FOLDER: writes there what this machine's cargo configuration says of registries.
cargo_registries() {
    local config=${CARGO_HOME:-$HOME/.cargo}/config.toml
    mkdir -p "$1"
    [ ! -f "$config" ] || awk '/^\[/ { keep = /^\[+(source|registr|http|net)/ } keep' "$config" \
        > "$1/config.toml"
}

# in_root FOLDER COMMAND...: runs the command as root in the root, with mounts and processes that end
# with it. The variables of this machine stay outside, except those that name registries.
in_root() {
    local root=$1 passed
    shift
    mapfile -t passed < <(env | grep -E \
        '^(https?_proxy|no_proxy|HTTPS?_PROXY|NO_PROXY|PIP_(EXTRA_)?INDEX_URL|PIP_TRUSTED_HOST|PIP_DEFAULT_TIMEOUT|CARGO_(HTTP|NET|REGISTRY|REGISTRIES|SOURCE)_[A-Z_]*)=')
    # The inner shell fills in the names.
    # shellcheck disable=SC2016
    unshare --mount --pid --fork --kill-child bash -eu -c '
        root=$1; shift
        mount --make-rprivate /
        mount --bind "$root" "$root"
        mount -t proc proc "$root/proc"
        mount --rbind /dev "$root/dev"
        mount -t sysfs -o ro sysfs "$root/sys"
        while [ "$1" = --bind ]; do
            mkdir -p "$root$3"
            mount --bind "$2" "$root$3"
            mount -o remount,bind,ro "$root$3"
            shift 3
        done
        exec chroot "$root" /usr/bin/env -i "$@"
    ' in_root "$root" "${binds[@]}" "${passed[@]}" \
        PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 "$@"
}
