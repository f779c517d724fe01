// On the sign-in page nobody is signed in: the key of what waits on this tablet goes. The entries stay, and the service gives the same
// key to the same person again. A database that was never made is not made here.
const known = indexedDB.databases ? await indexedDB.databases() : [];
if (known.some(({ name }) => name === "betaloop-visit-day")) {
  const request = indexedDB.open("betaloop-visit-day");
  request.onsuccess = () => {
    const db = request.result;
    if (db.objectStoreNames.contains("keys")) db.transaction("keys", "readwrite").objectStore("keys").clear();
    db.close();
  };
}
