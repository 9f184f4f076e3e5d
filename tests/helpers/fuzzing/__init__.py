"""A fuzzer of everything that neurad reads: scene folders, configs, command lines and checkpoints.

A case is a *recipe* of plain types: what it starts from and the mutations made to that, one after the other. They are
drawn, and a worker process carries them out, so that a crash or a hang there is a finding and not the end of a test.
"""
