#!/usr/bin/env bash
# A SLURM cluster of one machine, from Debian's packages: controller, node and munge, all below one folder.
#   one_machine_slurm.sh start FOLDER [CPUS]   installs slurm-wlm and munge where they are missing (needs root)
#   one_machine_slurm.sh stop FOLDER
# Afterwards: export SLURM_CONF=FOLDER/slurm.conf; sinfo
set -euo pipefail
command=$1
folder=$(realpath -m "$2")
cpus=${3:-4}
host=$(hostname -s)
export SLURM_CONF="$folder/slurm.conf"

if [ "$command" = stop ]; then
    for name in slurmd slurmctld munged; do
        [ -f "$folder/$name.pid" ] && kill "$(cat "$folder/$name.pid")" 2> /dev/null || true
    done
    exit 0
fi

if ! command -v slurmctld > /dev/null || ! command -v munged > /dev/null; then
    [ "$(id -u)" = 0 ] || { echo "needs slurm-wlm and munge: sudo apt-get install slurm-wlm munge" >&2; exit 3; }
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends slurm-wlm munge; } > /dev/null 2>&1 \
        || { echo "slurm-wlm and munge could not be installed" >&2; exit 3; }
fi

mkdir -p "$folder"/{state,spool}
chmod 711 "$folder"
dd if=/dev/urandom of="$folder/munge.key" bs=1 count=1024 status=none
chmod 400 "$folder/munge.key"
munged --force --key-file="$folder/munge.key" --socket="$folder/munge.socket" --pid-file="$folder/munged.pid" \
    --log-file="$folder/munged.log" --seed-file="$folder/munge.seed" > /dev/null

cat > "$SLURM_CONF" << END
ClusterName=one
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=26817
SlurmdPort=26818
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket,cred_expire=5
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
JobRequeue=1
KillWait=30
NodeName=$host NodeAddr=127.0.0.1 CPUs=$cpus State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
END
slurmctld
slurmd
for _ in $(seq 50); do
    sinfo --noheader --format %t 2> /dev/null | grep -q idle && exit 0
    sleep 0.2
done
echo "the node did not come up; see $folder/slurmctld.log and slurmd.log" >&2
exit 3
