const dialog = document.querySelector("dialog");
document.addEventListener("click", (event) => {
  const picture = event.target.closest("img.zoom");
  if (picture) {
    dialog.querySelector("img").src = picture.src;
    dialog.querySelector("p").textContent = picture.alt;
    dialog.showModal();
  } else if (dialog.open) dialog.close();
});
