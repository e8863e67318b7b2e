"""Keep a fleet's data sound: faults, quality, nights, verify, repair, forget, retention."""
