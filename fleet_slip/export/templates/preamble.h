/* ${version.reference}: ${angle.column}, exported by fleet-slip. Do not edit.
 * SHA-256 of the version: ${version.sha256}
 * Trained on ${trained.drives} drives, SHA-256 ${trained.drives_sha256 or "unknown"}
 */
