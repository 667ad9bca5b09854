// The slider of two pictures: a range input over them says how much of the left one shows.
"use strict";
for (const compare of document.querySelectorAll(".compare")) {
  const stage = compare.querySelector(".stage");
  const slider = compare.querySelector("input[type=range]");
  const [left, right] = compare.querySelectorAll("select");
  const pictures = [...stage.querySelectorAll("img")];
  const names = stage.querySelectorAll(".side");

  const move = () => {
    stage.style.setProperty("--split", slider.value + "%");
    slider.setAttribute(
      "aria-valuetext",
      Math.round(slider.value) + " % " + left.selectedOptions[0].textContent,
    );
  };
  const choose = () => {
    pictures.forEach((picture, i) => {
      // One picture can stand on both sides: then all of it shows.
      picture.classList.toggle("right", i === right.selectedIndex);
      picture.classList.toggle("left", i === left.selectedIndex && i !== right.selectedIndex);
    });
    names[0].textContent = left.selectedOptions[0].dataset.name;
    names[1].textContent = right.selectedOptions[0].dataset.name;
    move();
  };
  slider.addEventListener("input", move);
  left.addEventListener("change", choose);
  right.addEventListener("change", choose);
  choose(); // what the browser restored after a reload
}
