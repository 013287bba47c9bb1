"""A dataset on disk: its bags, logs, index, selections and exports."""
