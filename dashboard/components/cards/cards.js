/* The list of trials: one piece of HTML whose buttons tell the page what is wanted. */
export default function ({ data, parentElement, setTriggerValue }) {
  let list = parentElement.querySelector(".ll-items");
  if (!list) {
    list = document.createElement("ul");
    list.className = "ll-items";
    parentElement.append(list);
  }
  // What did not change stays, and the focus of the keyboard with it.
  if (list.liftlensHtml !== data.html) {
    list.liftlensHtml = data.html;
    list.innerHTML = data.html;
  }
  list.onclick = (event) => {
    const button = event.target.closest("button[data-action]");
    if (button) setTriggerValue("asked", { action: button.dataset.action, id: button.dataset.id });
  };
}
