"""Plan: optimal motions by direct transcription."""
