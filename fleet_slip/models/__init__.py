"""Model versions: manifests, aliases, signatures, publishing and scoring."""
