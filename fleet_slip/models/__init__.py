"""Model versions: manifests, aliases, publishing and scoring."""
