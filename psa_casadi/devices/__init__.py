"""Many devices: one job each, on every core, processes of a cluster too; results one by one."""
