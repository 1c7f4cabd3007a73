#!/usr/bin/env bash
# Install the stripped program and all files that belong to it below a folder.
#
#   scripts/install.sh PROGRAM FOLDER PREFIX
#
# PREFIX is the final location of FOLDER, for the paths in the systemd unit.
set -euo pipefail
program=$1 folder=$2 prefix=$3
root=$(cd "$(dirname "$0")/.." && pwd)
share=$folder/share

install -d "$folder/bin" "$folder/lib/sci-recon" "$folder/lib/systemd/system" "$share/man/man1" \
  "$share/bash-completion/completions" "$share/zsh/site-functions" "$share/fish/vendor_completions.d" \
  "$share/sci-recon" "$share/doc/sci-recon"
install -m 755 "$program" "$folder/bin/sci-recon"
strip "$folder/bin/sci-recon"
# The program looks for the library relative to its location.
install -m 644 "$root"/runtime/libonnxruntime*.so "$folder/lib/sci-recon/"
install -m 644 "$root"/runtime/onnxruntime-* "$root/LICENSE" "$share/doc/sci-recon/"
install -m 644 "$root/src/http/reference/LICENSE.txt" "$share/doc/sci-recon/redoc-LICENSE"
# The program includes its networks; these files are for training and for `--models`.
cp -R "$root/models" "$root/docs/schedule.schema.json" "$share/sci-recon/"
for unit in "$root"/deploy/systemd/*.service "$root"/deploy/systemd/*.timer; do
  sed "s|/usr/local/bin/|$prefix/bin/|" "$unit" >"$folder/lib/systemd/system/$(basename "$unit")"
done
"$program" man --out "$share/man/man1"
"$program" completions bash >"$share/bash-completion/completions/sci-recon"
"$program" completions zsh >"$share/zsh/site-functions/_sci-recon"
"$program" completions fish >"$share/fish/vendor_completions.d/sci-recon.fish"
echo "sci-recon $("$program" --version | cut -d' ' -f2-) is in $folder"
