# %% [markdown]
# # Identify and plot a night
# Sixty simulated frames of a camera of 12 deg. Each has three false stars, and a tenth of the stars
# are missing. For your own frames use `starcat.read_frames("night/*.jpg")`.

# %%
import matplotlib.pyplot as plt
import numpy as np

import starcat

built = starcat.build(starcat.preset("gaia-12deg"), "dist")
frames = starcat.simulate(built.folder, 60, drop_probability=0.1, false_stars=3, seed=5)
matcher = starcat.Matcher.open(built.folder, noise_px=0.5, noise_mag=0.3)
results = matcher.identify_many(frames)
print(sum(result.ok for result in results), "of", len(results), "frames identified")
print(results.table()["status", "n_matched", "residual_arcsec"][:3])

# %% [markdown]
# One frame with the names of its stars.

# %%
figure = results[0].plot("frame.png")

# %% [markdown]
# The directions of the camera, and the errors against the truth of the simulation.

# %%
ra = np.radians([result.boresight_ra_deg for result in results])
dec = np.radians([result.boresight_dec_deg for result in results])
errors = []
for frame, result in zip(frames, results, strict=True):
    turn = result.rotation().as_matrix() @ frame.matrix.T
    angle = np.arcsin(np.linalg.norm(turn - turn.T) / np.sqrt(8.0))
    errors.append(np.degrees(angle) * 3600.0)
figure = plt.figure(figsize=(10, 4))
sky = figure.add_subplot(1, 2, 1, projection="mollweide")
sky.scatter(np.angle(np.exp(1j * ra)), dec, s=12)
sky.grid(True)
histogram = figure.add_subplot(1, 2, 2)
histogram.hist(errors, bins=20)
histogram.set(xlabel="error of the attitude, arcsec", ylabel="frames")
print(f"median error {np.median(errors):.0f} arcsec")

# %% [markdown]
# A `Tracker` uses the last attitude. The first frame is lost in space, the next frames are tracked.

# %%
tracker = starcat.Tracker(matcher)
print([result.origin for result in tracker.follow([frames[0]] * 4)])
