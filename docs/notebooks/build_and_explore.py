# %% [markdown]
# # Build and explore a database
# The camera has 1024 x 1024 pixels and a field of 20 deg. `starcat.init` chooses the limit.

# %%
import matplotlib.pyplot as plt
import numpy as np

import starcat

camera = starcat.Camera(1024, 1024, fov_x_deg=20.0)
built = starcat.build(starcat.init(camera, "notebook").spec, "dist", replace=True)
database = starcat.open(built.folder)
print(database)

# %% [markdown]
# The table `stars` has units. `rejected` has a reason for each record that is not a guide star.

# %%
stars = database.stars.to_pandas()
print(stars[["designation", "ra_deg", "dec_deg", "mag"]].nsmallest(5, "mag"))
reasons = database.sql(
    "SELECT reason, count(*) AS records FROM rejected GROUP BY reason ORDER BY 2 DESC"
)
print(reasons.to_table())

# %% [markdown]
# How many stars does a field have? A frame with fewer than four stars cannot be identified.

# %%
summary = database.coverage().summary
print(summary.stars)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
left.bar(np.arange(len(summary.histogram)), summary.histogram)
left.set(xlabel="guide stars in a field", ylabel="fields")
right.hist(stars["mag"], bins=20)
right.set(xlabel="G magnitude", ylabel="guide stars")

# %% [markdown]
# How many stars has a database for a camera that sees only to G = 4.5?

# %%
spec = starcat.init(camera, "brighter", faint_limit_mag=4.5).spec
brighter = starcat.open(starcat.build(spec, "dist", replace=True).folder)
print(len(stars), "and", len(brighter.stars), "guide stars")
print("fewest stars in a field:", brighter.coverage().summary.stars.minimum)
