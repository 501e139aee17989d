for (const image of document.querySelectorAll("img[data-blink]")) {
  const own = image.src, truth = image.closest(".trio").querySelector("img").src;
  image.addEventListener("pointerenter", () => { image.src = truth; });
  image.addEventListener("pointerleave", () => { image.src = own; });
}

for (const figure of document.querySelectorAll("[data-rig]")) {  // parallel projection of across, away, up
  const rig = JSON.parse(figure.dataset.rig), svg = figure.querySelector("svg"), size = 190;
  let yaw = 0.5, pitch = 0.5, held = null;
  const place = ([x, y, z]) => {
    const across = x * Math.cos(yaw) - y * Math.sin(yaw), away = x * Math.sin(yaw) + y * Math.cos(yaw);
    return [480 + size * across, 210 - size * (z * Math.cos(pitch) + away * Math.sin(pitch))];
  };
  const make = (kind, values, text = "") => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
    for (const [name, value] of Object.entries(values)) element.setAttribute(name, value);
    element.textContent = text;
    return element;
  };
  const draw = () => {
    const parts = rig.volume ? [make("circle", { class: "volume", cx: 480, cy: 210, r: size * rig.volume })] : [];
    for (const camera of rig.cameras) {
      const [tip, ...corners] = camera.points.map(place), style = camera.held ? " held" : "";
      const rays = corners.map(corner => `M${tip}L${corner}`).join("");
      parts.push(make("path", { class: `camera${style}`, d: `${rays}M${corners.join("L")}Z` }));
      parts.push(make("text", { class: `name${style}`, x: tip[0] + 6, y: tip[1] + 4 }, camera.name));
    }
    svg.replaceChildren(...parts);
  };
  svg.addEventListener("pointerdown", event => { held = [event.clientX, event.clientY]; svg.setPointerCapture(event.pointerId); });
  svg.addEventListener("pointerup", () => { held = null; });
  svg.addEventListener("pointermove", event => {
    if (!held) return;
    yaw += (event.clientX - held[0]) / 200;
    pitch = Math.min(1.57, Math.max(-1.57, pitch + (event.clientY - held[1]) / 200));
    held = [event.clientX, event.clientY];
    draw();
  });
  figure.hidden = false;
  draw();
}
