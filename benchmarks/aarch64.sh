#!/bin/sh
# Does the whole job for a campaign on this machine and on an emulated AArch64 one, and compares every
# bit of the data files and of the model version.
#
#     benchmarks/aarch64.sh FOLDER [CAMPAIGN]
#
# Needs root, debootstrap and qemu-user-static on Debian 12, and `make setup` before.
set -eu
folder=$(mkdir -p "$1" && cd "$1" && pwd)
campaign=${2:-smoke}
python=$PWD/.venv/bin/python
system=$folder/system
packages=$folder/packages

if [ ! -e "$system/usr/bin/python3.11" ]; then
    debootstrap --arch=arm64 --foreign --variant=minbase --include=python3 bookworm "$system"
    for package in "$system"/var/cache/apt/archives/*.deb; do dpkg -x "$package" "$system"; done
fi

if [ ! -d "$packages" ]; then
    # Versions as here; a package without a wheel for AArch64 is named and left out.
    platforms=$(seq -f '--platform manylinux_2_%.0f_aarch64' 17 36)
    "$python" -m pip freeze --exclude-editable | while read -r package; do
        # shellcheck disable=SC2086 # many words
        "$python" -m pip install --quiet --target "$packages" --no-deps --only-binary=:all: \
            --python-version 3.11 --platform manylinux2014_aarch64 $platforms "$package" ||
            echo "without $package"
    done
fi
"$python" -m pip install --quiet --target "$packages" --upgrade --no-deps .

run() {
    "$@" -c 'from fleet_slip.cli.main import main; main()' --root "$root" run --campaign "$campaign"
}

digests() {
    cd "$1"
    find . -name '*.parquet' ! -path '*/_delta_log/*' -o -path '*/versions/*.json' | sort | xargs sha256sum
}

root=$folder/here
run "$python"
root=$folder/aarch64
PYTHONPATH=$packages NUMBA_CACHE_DIR=$folder/numba run \
    qemu-aarch64-static -L "$system" "$system/usr/bin/python3.11"
(digests "$folder/here") > "$folder/here.txt"
(digests "$folder/aarch64") > "$folder/aarch64.txt"
diff "$folder/here.txt" "$folder/aarch64.txt"
echo "the same bits in $(wc -l < "$folder/here.txt") files"
