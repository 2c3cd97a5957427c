# %% [markdown]
# # Query catalogs
# The embedded sky is a table of 482,176 stars. A database can be joined with it.

# %%
import matplotlib.pyplot as plt

import starcat

built = starcat.build(starcat.preset("gaia-12deg"), "dist")
connection = starcat.connect("gaia", str(built.folder))
print(connection.sql("SELECT count(*) AS stars, min(mag) AS brightest FROM gaia.stars").to_table())

# %% [markdown]
# The stars of the Pleiades, with their colours.

# %%
pleiades = connection.sql(
    "SELECT designation, mag, colour_mag FROM gaia.cone(56.75, 24.12, 1.5) ORDER BY mag"
).to_pandas()
print(pleiades.head())
figure, axes = plt.subplots(figsize=(5, 5))
axes.scatter(pleiades["colour_mag"], pleiades["mag"], s=8)
axes.set(xlabel="BP - RP", ylabel="G", ylim=(10.5, 2.5))

# %% [markdown]
# Which stars brighter than G = 6 are not guide stars of the database, and why?

# %%
lost = connection.sql(
    "SELECT reason, count(*) AS stars FROM gaia_12deg.rejected WHERE mag < 6 GROUP BY reason"
)
print(lost.to_table())

# %% [markdown]
# Close pairs: guide stars and the stars within a minute of arc that are too faint for the database.
# The camera sees both as one spot.

# %%
pairs = connection.sql(
    "SELECT a_designation, a_mag, b_mag, separation_arcsec "
    "FROM crossmatch('gaia_12deg.stars', 'gaia_12deg.rejected', 60) "
    "WHERE b_reason = 'too_faint' ORDER BY separation_arcsec LIMIT 5"
)
print(pairs.to_table())
connection.close()
