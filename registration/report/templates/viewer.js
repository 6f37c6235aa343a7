{
  const box = document.getElementById("viewer");
  const start = box.querySelector(".start");
  const unpacked = async (id) => {
    const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };
  const possible = () => {
    const canvas = document.createElement("canvas");
    return "DecompressionStream" in window && Boolean(canvas.getContext("webgl2"));
  };
  // The file ends with the vertex colours, so that another colouring replaces its last bytes.
  const show = async (viewer, glb, colours) => {
    if (colours) glb.set(colours, glb.length - colours.length);
    const old = viewer.src;
    viewer.src = URL.createObjectURL(new Blob([glb], { type: "model/gltf-binary" }));
    if (old) URL.revokeObjectURL(old);
  };
  const open = async () => {
    const script = document.createElement("script");
    script.type = "module";
    script.textContent = new TextDecoder().decode(await unpacked("viewer-code"));
    document.head.append(script);
    await customElements.whenDefined("model-viewer");
    const viewer = document.createElement("model-viewer");
    for (const [name, value] of Object.entries({
      "camera-controls": "", "touch-action": "pan-y", "interaction-prompt": "none", "camera-orbit": "0deg 85deg auto",
      "min-camera-orbit": "auto 0deg 5%", "max-camera-orbit": "auto 180deg auto", "min-field-of-view": "5deg",
      "field-of-view": "25deg", "shadow-intensity": "0", "tone-mapping": "neutral", exposure: "0.85", alt: "the registered mesh",
    })) viewer.setAttribute(name, value);
    const glb = await unpacked("viewer-glb");
    viewer.addEventListener("load", () => { box.dataset.state = "shown"; });
    await show(viewer, glb);
    box.querySelector(".poster").replaceWith(viewer);
    start.remove();
    const modes = box.querySelector(".modes");
    modes.hidden = false;
    modes.addEventListener("click", async (event) => {
      const id = event.target.dataset.colours;
      if (!id) return;
      for (const button of modes.children) button.classList.toggle("on", button === event.target);
      await show(viewer, glb, await unpacked(id));
    });
  };
  const fail = () => {
    start.remove();
    box.querySelector(".note").hidden = false;
    box.dataset.state = "failed";
  };
  start.addEventListener("click", () => {
    start.disabled = true;
    start.textContent = "Loading …";
    if (possible()) open().catch(fail);
    else fail();
  });
}
