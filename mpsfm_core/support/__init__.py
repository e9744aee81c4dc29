"""Files, arrays on disk, YAML, compilation and threads: support code without any SfM."""
