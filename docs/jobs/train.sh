#!/usr/bin/env bash
# One process of a training run on several hosts: starts the run, or continues it from its last checkpoint, so
# that a scheduler may restart the job as often as it must. Every process runs it with the same variables:
#
#   CAPTURE  the capture, in a folder that all hosts read
#   RUN      the folder of the run, on a file system that all hosts share
#   HOSTS    auto, or ADDRESS:PORT,COUNT,INDEX (see splatax train --help)
#   OPTIONS  of a new run, such as "--steps 30000 --views 64"
set -euo pipefail
: "${CAPTURE:?} ${RUN:?} ${HOSTS:?} ${OPTIONS:?}"

if compgen -G "$RUN/checkpoints/[0-9]*.npz" > /dev/null; then
  exec splatax train --resume "$RUN" --hosts "$HOSTS"
elif [ -e "$RUN/scene.ply" ]; then
  echo "$RUN: holds a finished run"
else  # perhaps a run that was stopped before its first checkpoint
  # shellcheck disable=SC2086  # OPTIONS are several words
  exec splatax train "$CAPTURE" --out "$RUN" --overwrite --hosts "$HOSTS" --checkpoint-steps 500 $OPTIONS
fi
