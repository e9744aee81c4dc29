"""Models of the Hugging Face Hub that the library transformers can run."""
