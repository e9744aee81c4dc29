"""What the std of a prior means: the model of its uncertainty, and the files that hold one."""
