"""Reading and writing files: the border where file conventions become ours."""
