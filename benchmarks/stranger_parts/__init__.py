"""What benchmarks/newcomer.py and wrong_inputs.py share: commands, mistakes, scores."""
