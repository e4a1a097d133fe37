// Comparison sliders: the left picture is uncovered up to the handle; both sides can be chosen.
for (const box of document.querySelectorAll(".slider")) {
  const handle = box.querySelector("input");
  const move = () => box.style.setProperty("--at", handle.value + "%");
  handle.addEventListener("input", move);
  for (const choice of box.querySelectorAll("select")) {
    const picture = box.querySelector(choice.dataset.side === "left" ? ".over img" : ".under");
    choice.addEventListener("change", () => {
      const source = document.getElementById(choice.value);
      picture.src = source.src;
      picture.alt = source.alt;
    });
  }
  move();
}
