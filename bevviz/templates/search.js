// Search over the findings: words that a row has to hold, its kind, class and reason, and its range in metres.
const search = document.querySelector(".search");
if (search) {
  search.hidden = false;
  const rows = [...document.querySelectorAll(".findings tbody tr")];
  const fields = Object.fromEntries([...search.querySelectorAll("[name]")].map((field) => [field.name, field]));
  const count = search.querySelector("output");
  const apply = () => {
    const words = fields.text.value.toLowerCase().split(/\s+/).filter(Boolean);
    const [near, far] = [fields.near, fields.far].map((field) => (field.value === "" ? null : Number(field.value)));
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      const range = row.dataset.range === "" ? null : Number(row.dataset.range);
      row.hidden = !(
        words.every((word) => text.includes(word)) &&
        ["kind", "label", "reason"].every((name) => !fields[name].value || fields[name].value === row.dataset[name]) &&
        (near === null || (range !== null && range >= near)) &&
        (far === null || (range !== null && range <= far))
      );
      shown += !row.hidden;
    }
    count.value = `${shown} of ${rows.length}`;
  };
  search.addEventListener("input", apply);
  apply();
}
