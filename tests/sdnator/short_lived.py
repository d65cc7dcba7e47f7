"""A part that is ready and then dies at once."""

print('{"ready": true}', flush=True)
