for (const image of document.querySelectorAll("img[data-blink]")) {
  const own = image.src, truth = image.closest(".trio").querySelector("img").src;
  image.addEventListener("pointerenter", () => { image.src = truth; });
  image.addEventListener("pointerleave", () => { image.src = own; });
}
