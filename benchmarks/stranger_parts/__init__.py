"""What benchmarks/wrong_inputs.py is made of: right recordings, mistakes, commands, scores."""
