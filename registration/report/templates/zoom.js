const dialog = document.querySelector("dialog");
document.addEventListener("click", (event) => {
  const image = event.target.closest("img.zoom");
  if (image) {
    dialog.querySelector("img").src = image.src;
    dialog.querySelector("p").textContent = image.alt;
    dialog.showModal();
  } else if (dialog.open) dialog.close();
});
