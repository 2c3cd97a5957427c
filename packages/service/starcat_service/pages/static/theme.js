// The theme that was chosen, before anything is painted.
{
  let theme = null;
  try {
    theme = localStorage.getItem("theme");
  } catch {
    // Without storage the system's theme is taken.
  }
  if (theme === "light" || theme === "dark") document.documentElement.dataset.theme = theme;
}
