"""Pictures in files: names of layers in an EXR, PNG for screens, denoising."""
